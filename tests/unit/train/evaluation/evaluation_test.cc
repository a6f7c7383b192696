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

// The policy always decides 1. With a delay of k steps the first k actions are 0.
TEST(EvaluationTest, DecisionsAreExecutedAfterTheDelayAndDelaysTakeTurns) {
  const std::shared_ptr<Policy> policy = CartPolePolicy();
  Linear& head = policy->weights.head;
  head.weight.values.assign(head.weight.values.size(), 0.0f);
  head.bias.values = {0.0f, 1.0f};
  const auto returns = [&](int least, int most, int episodes, uint64_t seed) {
    const EvaluationOptions options = {
        .episodes = episodes, .first_seed = seed, .delay = {.least = least, .most = most}};
    return Evaluate(policy, options)->returns;
  };
  const double at_once = returns(0, 0, 1, 1'000'001)[0], late = returns(3, 3, 1, 1'000'001)[0];
  EXPECT_GT(late, at_once);  // three pushes to the other side first
  EXPECT_EQ(returns(0, 3, 2, 1'000'000)[1], returns(1, 1, 1, 1'000'001)[0]);
  const EvaluationOptions options = {.episodes = 1, .delay = {.least = 0, .most = 2}};
  EXPECT_EQ(ToJson(*Evaluate(policy, options), policy->config)["delay"].dump(), "[0,2]");
  EXPECT_FALSE(ToJson(*Evaluate(policy, {.episodes = 1}), policy->config).contains("delay"));
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
