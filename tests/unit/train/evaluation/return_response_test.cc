// Tests of the comparison of target returns with achieved returns.
#include "train/evaluation/return_response.h"

#include <gtest/gtest.h>

#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

TEST(RankCorrelationTest, FollowsOrderAndSharesTies) {
  EXPECT_NEAR(RankCorrelation({1, 2, 3}, {10, 100, 1000}), 1.0, 1e-12);
  EXPECT_NEAR(RankCorrelation({1, 2, 3}, {3, 2, 1}), -1.0, 1e-12);
  EXPECT_NEAR(RankCorrelation({1, 2, 3, 4}, {1, 2, 2, 3}), 0.9487, 1e-4);  // from SciPy's spearmanr
  EXPECT_EQ(RankCorrelation({1, 2, 3}, {5, 5, 5}), 0.0);
}

Evaluation Returning(std::vector<double> returns) {
  Evaluation evaluation;
  evaluation.returns = std::move(returns);
  return evaluation;
}

TEST(ReturnResponseTest, ErrorIsAShareOfTheRangeAsked) {
  const ReturnResponse response = {.asked = {100.0, 300.0},
                                   .evaluations = {Returning({90, 110}), Returning({300, 260})}};
  EXPECT_NEAR(response.mean_error(), (10 + 10 + 0 + 40) / 4.0 / 200.0, 1e-12);
  EXPECT_GT(response.rank_correlation(), 0.8);
}

TEST(ReturnResponseTest, NeedsTwoDifferentTargets) {
  EXPECT_EQ(MeasureReturnResponse(SmallPolicy(), {5.0, 5.0}, {}).status().message(),
            "target_returns: expected two different ones at least");
}

}  // namespace
}  // namespace spikeserve
