#include "train/evaluation/rounding_loss.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <utility>
#include <vector>

#include "tests/support/small_policy.h"
#include "train/evaluation/calibration.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

Policy CartPolePolicy(uint64_t seed) {
  Policy policy = SmallPolicy(SmallConfig(), ActionSpace::Discrete(2), seed);
  policy.environment = "CartPole-v1";
  return policy;
}

// Returns the comparison of two policies with these returns.
PairedEvaluation Returning(std::vector<double> before, std::vector<double> after) {
  const EvaluationOptions options = {.episodes = static_cast<int>(before.size()), .first_seed = 7};
  PairedEvaluation pair;
  pair.first.options = pair.second.options = options;
  pair.first.returns = std::move(before);
  pair.second.returns = std::move(after);
  return pair;
}

TEST(LostReturnTest, IsAShareOfTheDistanceFromRandomActions) {
  const PairedEvaluation pair = Returning({500, 500, 500, 500}, {180, 170, 160, 170});
  const auto loss = LostReturn(CartPolePolicy(1), pair);
  ASSERT_TRUE(loss.ok()) << loss.status();
  // Random actions balance for some twenty steps.
  EXPECT_GT(loss->range, 450.0);
  EXPECT_LT(loss->range, 490.0);
  EXPECT_NEAR(loss->loss.mean, 330.0 / loss->range, 1e-9);
  const absl::Status refused = CheckLoss(*loss, 0.01);
  EXPECT_EQ(refused.code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(refused.message(),
              HasSubstr("--max_loss: expected a loss of at most 0.01 of the range "
                        "of the return, received "));
  EXPECT_THAT(refused.message(), HasSubstr("--arithmetic=integer"));
  EXPECT_TRUE(CheckLoss(*loss, 0.9).ok());
  EXPECT_EQ(ToJson(*loss)["measure"], "return");
}

TEST(LostReturnTest, ASmallLossAndOneThatChanceExplainsAreAccepted) {
  const Policy policy = CartPolePolicy(1);
  EXPECT_TRUE(CheckLoss(*LostReturn(policy, Returning({500, 500}, {499, 498})), 0.01).ok());
  const PairedEvaluation noise = Returning({500, 400, 500, 450}, {400, 500, 450, 420});
  EXPECT_GT(LostReturn(policy, noise)->loss.mean, 0.01);
  EXPECT_TRUE(CheckLoss(*LostReturn(policy, noise), 0.01).ok());
}

TEST(LostReturnTest, APolicyThatIsNoBetterThanChanceHasNothingToLose) {
  const auto loss = LostReturn(CartPolePolicy(1), Returning({9, 9}, {8, 8}));
  EXPECT_EQ(loss->loss.mean, 0.0);
}

TEST(LostAgreementTest, ComparesTheDecisionsWithTheRecordedActions) {
  const Policy policy = CartPolePolicy(1);
  const std::vector<Episode> episodes = *PlayCalibrationEpisodes(policy);
  EXPECT_EQ(LostAgreement(policy, policy, episodes).loss.mean, 0.0);
  const RoundingLoss loss = LostAgreement(policy, CartPolePolicy(2), episodes);
  EXPECT_GT(loss.loss.mean, 0.0) << "the recorded actions are those of the first policy";
  EXPECT_LE(loss.loss.mean, 1.0);
}

TEST(LostAgreementTest, OfContinuousActionsIsAShareOfTheBounds) {
  const ActionSpace space = ActionSpace::Box({-2.0f}, {2.0f});
  const Policy policy = SmallPolicy(SmallConfig(), space, 1);
  Episode episode;
  for (int step = 0; step < 5; ++step) {
    episode.observations.insert(episode.observations.end(),
                                static_cast<size_t>(policy.observation_size()), 0.1f);
    episode.actions.push_back({.continuous = {-2.0f}});
    episode.rewards.push_back(0.0);
  }
  const auto agrees = [&](float bias) {
    Policy made = policy;
    made.weights.head.weight = Tensor::Zeros(made.weights.head.weight.shape);
    made.weights.head.bias.values = {bias};
    return made;
  };
  // The first decides the lower bound, as recorded, and the second the upper one.
  EXPECT_NEAR(LostAgreement(agrees(-50.0f), agrees(50.0f), {episode}).loss.mean, 1.0, 1e-3);
}

}  // namespace
}  // namespace spikeserve
