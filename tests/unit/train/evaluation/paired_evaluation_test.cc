#include "train/evaluation/paired_evaluation.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>

#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using testing::Each;

Policy CartPolePolicy(uint64_t seed) {
  Policy policy = SmallPolicy(SmallConfig(), ActionSpace::Discrete(2), seed);
  policy.environment = "CartPole-v1";
  return policy;
}

TEST(MeanWithIntervalTest, IsThatOfTheNormalApproximation) {
  const MeanInterval interval = MeanWithInterval({1.0, 2.0, 3.0, 6.0});
  EXPECT_DOUBLE_EQ(interval.mean, 3.0);
  // The sample deviation is sqrt(14 / 3), and the margin 1.959964 sqrt(14 / 3 / 4).
  EXPECT_NEAR(interval.low, 3.0 - 2.117003, 1e-5);
  EXPECT_NEAR(interval.high, 3.0 + 2.117003, 1e-5);
}

TEST(MeanWithIntervalTest, OneValueHasNoSpread) {
  const MeanInterval interval = MeanWithInterval({-2.0});
  EXPECT_EQ(interval.low, -2.0);
  EXPECT_EQ(interval.high, -2.0);
}

TEST(EvaluatePairTest, APolicyDoesNotDifferFromItself) {
  const auto policy = std::make_shared<const Policy>(CartPolePolicy(1));
  const absl::StatusOr<PairedEvaluation> pair =
      EvaluatePair(policy, policy, {.episodes = 4, .first_seed = 7});
  ASSERT_TRUE(pair.ok()) << pair.status();
  EXPECT_THAT(pair->differences(), Each(0.0));
  const nlohmann::ordered_json json = ToJson(*pair);
  EXPECT_EQ(json["mean_difference"], 0.0);
  EXPECT_EQ(json["spikes_per_decision"][0], json["spikes_per_decision"][1]);
}

TEST(EvaluatePairTest, DifferencesAreSecondMinusFirstOnEqualStarts) {
  const auto first = std::make_shared<const Policy>(CartPolePolicy(1));
  const auto second = std::make_shared<const Policy>(*QuantizeToInteger(CartPolePolicy(2)));
  const EvaluationOptions options = {.episodes = 3, .first_seed = 11};
  const absl::StatusOr<PairedEvaluation> pair = EvaluatePair(first, second, options);
  ASSERT_TRUE(pair.ok()) << pair.status();
  const std::vector<double> a = Evaluate(first, options)->returns;
  const std::vector<double> b = Evaluate(second, options)->returns;
  for (size_t i = 0; i < a.size(); ++i) EXPECT_EQ(pair->differences()[i], b[i] - a[i]);
  EXPECT_EQ(ToJson(*pair)["first_seed"], 11);
}

}  // namespace
}  // namespace spikeserve
