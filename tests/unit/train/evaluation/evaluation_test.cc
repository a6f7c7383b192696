#include "train/evaluation/evaluation.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <memory>
#include <utility>
#include <vector>

#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"
#include "train/evaluation/calibration.h"
#include "train/evaluation/paired_evaluation.h"
#include "train/evaluation/return_response.h"
#include "train/evaluation/rounding_loss.h"

namespace spikeserve {
namespace {

using ::testing::Each;
using ::testing::HasSubstr;

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

TEST(MeanWithIntervalTest, OneValueHasNoInterval) {
  const MeanInterval interval = MeanWithInterval({-2.0});
  EXPECT_EQ(interval.mean, -2.0);
  EXPECT_EQ(interval.low, -HUGE_VAL);
  EXPECT_EQ(interval.high, HUGE_VAL);
  EXPECT_FALSE(interval.is_bounded());
  EXPECT_TRUE(MeanWithInterval({-2.0, -2.0}).is_bounded());
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
  const absl::Status refused = CheckLoss(*loss, 0.01, "train");
  EXPECT_EQ(refused.code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(refused.message(),
              HasSubstr("--max_loss: expected a loss of at most 0.01 of the range "
                        "of the return, received "));
  EXPECT_THAT(refused.message(), HasSubstr(": train, or accept the loss by --allow_loss"));
  EXPECT_FALSE(IsTooMuch(*loss, 0.9));
  EXPECT_EQ(ToJson(*loss)["measure"], "return");
}

TEST(LostReturnTest, ASmallLossAndOneThatChanceExplainsAreAccepted) {
  const Policy policy = CartPolePolicy(1);
  EXPECT_FALSE(IsTooMuch(*LostReturn(policy, Returning({500, 500}, {499, 498})), 0.01));
  const PairedEvaluation noise = Returning({500, 400, 500, 450}, {400, 500, 450, 420});
  EXPECT_GT(LostReturn(policy, noise)->loss.mean, 0.01);
  EXPECT_FALSE(IsTooMuch(*LostReturn(policy, noise), 0.01));
}

TEST(LostReturnTest, OneEpisodeShowsNoLoss) {
  const PairedEvaluation one = Returning({500}, {170});
  const auto loss = LostReturn(CartPolePolicy(1), one);
  ASSERT_TRUE(loss.ok()) << loss.status();
  EXPECT_FALSE(IsTooMuch(*loss, 0.01));
  EXPECT_THAT(ToText(*loss), HasSubstr("of the range of the return (one episode has no interval)"));
  EXPECT_THAT(ToText(one, "before", "after"),
              HasSubstr("difference -330.000 (one episode has no interval)"));
  EXPECT_EQ(ToJson(*loss)["share_95_percent"].dump(), "[null,null]");
}

TEST(LostReturnTest, APolicyThatIsNoBetterThanChanceHasNothingToLose) {
  const auto loss = LostReturn(CartPolePolicy(1), Returning({9, 9}, {8, 8}));
  EXPECT_EQ(loss->loss.mean, 0.0);
}

TEST(LostReturnTest, ReturnsOfAnotherProgramAreJudgedAlike) {
  const auto loss = ParseLostReturn(R"({"before": [110, 90], "after": [60, 40], "random": [0]})");
  ASSERT_TRUE(loss.ok()) << loss.status();
  EXPECT_EQ(loss->range, 100.0);
  EXPECT_EQ(loss->loss.mean, 0.5);
  for (const char* text :
       {"", "[]", R"({"before": [1], "after": [], "random": [0]})",
        R"({"before": [1], "after": ["x"], "random": [0]})", R"({"before": [1], "after": [1]})",
        R"({"before": [1, null], "after": [1, 0], "random": [0]})",
        R"({"before": [1], "after": [0], "random": [null]})"}) {
    EXPECT_EQ(ParseLostReturn(text).status().code(), absl::StatusCode::kInvalidArgument) << text;
  }
}

TEST(RoundingLossTest, ATinyGainIsNoLossOfMinusNothing) {
  RoundingLoss loss = {.measure = "return", .range = 1.0, .loss = {-1e-5, -0.01, -0.0}};
  EXPECT_EQ(ToText(loss),
            "the integers lost 0.00 % of the range of the return (95 %: -1.00 to 0.00 %)");
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
