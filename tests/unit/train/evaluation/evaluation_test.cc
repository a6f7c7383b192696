#include "train/evaluation/evaluation.h"

#include <gtest/gtest.h>

#include <memory>

#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

std::shared_ptr<Policy> CartPolePolicy() {
  auto policy = std::make_shared<Policy>(SmallPolicy());
  policy->environment = "CartPole-v1";
  policy->target_return = 500.0f;
  return policy;
}

TEST(EvaluationTest, EveryFigureNamesItsDenominatorAndTheyAgree) {
  const std::shared_ptr<Policy> policy = CartPolePolicy();
  const absl::StatusOr<Evaluation> evaluation =
      Evaluate(policy, {.episodes = 3, .first_seed = 1'000'000});
  ASSERT_TRUE(evaluation.ok()) << evaluation.status();
  const nlohmann::ordered_json json = ToJson(*evaluation, policy->config);
  const double decisions = json["decisions"];
  EXPECT_EQ(decisions, 3.0 * json["mean_return"].get<double>());  // the reward of a step is 1
  const double per_decision = json["spikes_per_decision"];
  EXPECT_GT(per_decision, 0.0);
  double stages = 0.0;
  for (const auto& spikes : json["spikes_per_decision_by_stage"]) stages += spikes.get<double>();
  EXPECT_NEAR(stages, per_decision, 1e-9);
  EXPECT_NEAR(json["spikes_per_window"], 4.0 * per_decision, 1e-9);
  EXPECT_NEAR(json["spikes_per_token_and_tick"].get<double>() * 5.0 * (3.0 * decisions - 3.0),
              per_decision * decisions, 1e-6);
}

TEST(EvaluationTest, SameSeedsGiveTheSameReturns) {
  const EvaluationOptions options = {.episodes = 2, .first_seed = 1'000'007};
  EXPECT_EQ(Evaluate(CartPolePolicy(), options)->returns,
            Evaluate(CartPolePolicy(), options)->returns);
}

TEST(EvaluationTest, PolicyMustFitItsEnvironment) {
  const std::shared_ptr<Policy> policy = CartPolePolicy();
  EXPECT_EQ(Evaluate(policy, {.episodes = 0}).status().message(),
            "episodes: expected at least 1, received 0");
  policy->environment = "Acrobot-v1";
  EXPECT_EQ(Evaluate(policy, {}).status().message(),
            "policy: expected the observations and actions of Acrobot-v1");
  policy->environment = "Pong-v5";
  EXPECT_EQ(Evaluate(policy, {}).status().code(), absl::StatusCode::kNotFound);
}

}  // namespace
}  // namespace spikeserve
