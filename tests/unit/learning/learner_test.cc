#include "core/learning/learner.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "core/learning/frobenius_norm.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

constexpr size_t kOutputs = 2;
constexpr size_t kInputs = 3;

Policy TestPolicy() {
  Policy policy;
  policy.action_space = ActionSpace::Discrete(kOutputs);
  policy.weights.head.weight = {.shape = {kOutputs, kInputs},
                                .values = {0.3f, -0.2f, 0.1f, 0.0f, 0.5f, -0.4f}};
  policy.weights.head.bias = {.shape = {kOutputs}, .values = {0.1f, -0.1f}};
  policy.modulator_mean = 4.0f;
  policy.modulator_std = 2.0f;
  return policy;
}

std::vector<float> ReadoutAt(int t) {
  return {static_cast<float>((t * 3) % 10) / 10, static_cast<float>((t * 7) % 10) / 10, 0.5f};
}

// A decision as the test remembers it. The learner does not keep these values.
struct Step {
  std::vector<double> trace;
  double return_to_go;
  double reward;  // of this decision
};

// Returns G_t of every step; `beyond` is the return after the last step.
std::vector<double> Returns(const std::vector<Step>& steps, double discount, double beyond) {
  std::vector<double> returns(steps.size());
  double following = beyond;
  for (size_t t = steps.size(); t-- > 0;) {
    following = steps[t].reward + discount * following;
    returns[t] = following;
  }
  return returns;
}

class LearnerTest : public ::testing::Test {
 protected:
  Learner NewLearner(const LearningOptions& options) {
    return Learner::New(options, policy_, Eigen::VectorXf::Zero(kOutputs * kInputs));
  }

  double Drift() const { return FrobeniusNorm(learner_.head_delta) / BaseNorm(policy_); }

  // Plays `steps` decisions with the rewards 0.3, 0.6, 0.9, 0.3 and so on. Returns the steps, with
  // traces that the test computes in double precision.
  std::vector<Step> Play(const LearningOptions& options, int steps, double target_return) {
    std::vector<Step> kept;
    std::vector<double> trace(kOutputs * kInputs, 0.0);
    double rewards = 0.0;
    for (int t = 0; t < steps; ++t) {
      const ActionChoice choice =
          ChooseAction(HeadWith(policy_, learner_.head_delta), policy_.action_space, ReadoutAt(t),
                       {.sample = true}, 1000 + t);
      const double return_to_go = target_return - rewards;
      learner_.OnDecision(options, policy_, choice, ReadoutAt(t), return_to_go, reward_);
      const std::vector<float> r = ReadoutAt(t);
      for (size_t i = 0; i < kOutputs; ++i) {
        const double y = (choice.action.discrete == static_cast<int>(i) ? 1.0 : 0.0) -
                         static_cast<double>(choice.probabilities[i]);
        for (size_t j = 0; j < kInputs; ++j) {
          double& e = trace[i * kInputs + j];
          e = options.trace_decay * e + y * static_cast<double>(r[j]);
        }
      }
      reward_ = 0.3 * (t % 3 + 1);
      rewards += reward_;
      kept.push_back({trace, return_to_go, reward_});
    }
    return kept;
  }

  Policy policy_ = TestPolicy();
  Learner learner_;
  double reward_ = 0.0;  // of the last decision
};

TEST(FrobeniusNormTest, IsTheRootOfTheSumOfSquares) {
  EXPECT_EQ(FrobeniusNorm(Eigen::VectorXf{{3.0f, -4.0f}}), 5.0);
}

TEST_F(LearnerTest, TheTraceDecaysAndAddsTheOuterProduct) {
  const LearningOptions options = {.trace_decay = 0.5};
  policy_.action_space = ActionSpace::Box({-1.0f, -1.0f}, {1.0f, 1.0f});
  learner_ = NewLearner(options);
  ActionChoice choice;
  choice.noise = {1.0f, -2.0f};  // y of a sampled Box action
  learner_.OnDecision(options, policy_, choice, {0.0f, 1.0f, 0.5f}, 0.0, 0.0);
  EXPECT_EQ(learner_.trace, (Eigen::VectorXf{{0.0f, 1.0f, 0.5f, 0.0f, -2.0f, -1.0f}}));
  choice.noise = {1.0f, 0.0f};
  learner_.OnDecision(options, policy_, choice, {1.0f, 0.0f, 0.0f}, 0.0, 0.0);
  EXPECT_EQ(learner_.trace, (Eigen::VectorXf{{1.0f, 0.5f, 0.25f, 0.0f, -1.0f, -0.5f}}));
}

TEST_F(LearnerTest, TargetAddsEveryStepAtOnce) {
  const LearningOptions options = {.modulator = Modulator::kTarget, .learning_rate = 0.01};
  learner_ = NewLearner(options);
  std::vector<double> expected(kOutputs * kInputs, 0.0);
  for (const Step& step : Play(options, 40, /*target_return=*/9.0)) {
    const double delta = std::min(1.0, std::max(-1.0, (step.return_to_go - 4.0) / 2.0));
    for (size_t i = 0; i < expected.size(); ++i) {
      expected[i] += options.learning_rate * delta * step.trace[i];
    }
  }
  EXPECT_EQ(learner_.updates, 40);
  for (size_t i = 0; i < expected.size(); ++i) {
    EXPECT_NEAR(learner_.head_delta[i], expected[i], 1e-6) << i;
  }
}

// The learner's sums of constant size give the same update as storing every trace, for terminated
// and for truncated episodes.
TEST_F(LearnerTest, RealizedEqualsTheSumOverAllSteps) {
  for (const double discount : {1.0, 0.9}) {
    for (const bool terminated : {true, false}) {
      const LearningOptions options = {.learning_rate = 0.001, .discount = discount, .clip = 100.0};
      learner_ = NewLearner(options);
      learner_.returns = {.mean = 1.0, .variance = 0.25, .decisions = 60.0};
      const std::vector<Step> kept = Play(options, 40, 9.0);
      EXPECT_EQ(FrobeniusNorm(learner_.head_delta), 0.0);
      learner_.OnEpisodeEnd(options, policy_, reward_, terminated);

      double mean_reward = 0.0;
      for (const Step& step : kept) mean_reward += step.reward / 40;
      const bool goes_on = !terminated && discount < 1.0;
      const std::vector<double> returns =
          Returns(kept, discount, goes_on ? mean_reward / (1.0 - discount) : 0.0);
      double sum = 60 * 1.0, squares = 60 * (0.25 + 1.0);
      for (const double g : returns) sum += g, squares += g * g;
      const double mean = sum / 100, variance = squares / 100 - mean * mean;
      double about_mean = 0.0;
      for (const double g : returns) about_mean += (g - mean) * (g - mean) / 40;
      const double scale = std::sqrt(std::max(variance, about_mean));
      EXPECT_NEAR(learner_.returns.mean, mean, 1e-9);
      EXPECT_NEAR(learner_.returns.variance, variance, 1e-9);

      std::vector<double> expected(kOutputs * kInputs, 0.0);
      for (size_t t = 0; t < kept.size(); ++t) {
        for (size_t i = 0; i < expected.size(); ++i) {
          expected[i] += options.learning_rate * (returns[t] - mean) / scale * kept[t].trace[i];
        }
      }
      for (size_t i = 0; i < expected.size(); ++i) {
        EXPECT_NEAR(learner_.head_delta[i], expected[i], 1e-6) << i;
      }
      EXPECT_EQ(learner_.updates, 1);
    }
  }
}

TEST_F(LearnerTest, MemoryDoesNotGrowWithTheEpisode) {
  const LearningOptions options = {.modulator = Modulator::kRealized};
  learner_ = NewLearner(options);
  Play(options, 5000, 9.0);
  EXPECT_EQ(learner_.trace.size(), kOutputs * kInputs);
  EXPECT_EQ(learner_.trace_sum.size(), kOutputs * kInputs);
  EXPECT_EQ(learner_.discounted_trace.size(), kOutputs * kInputs);
  EXPECT_EQ(learner_.credit.size(), kOutputs * kInputs);
}

TEST_F(LearnerTest, OneStepIsNoLongerThanTheClip) {
  for (const Modulator modulator : {Modulator::kTarget, Modulator::kRealized}) {
    const LearningOptions options = {.modulator = modulator, .learning_rate = 1e30, .clip = 0.125};
    learner_ = NewLearner(options);
    // After a single decision the realized modulator is zero, because the return equals the mean.
    Play(options, modulator == Modulator::kTarget ? 1 : 3, /*target_return=*/9.0);
    learner_.OnEpisodeEnd(options, policy_, 9.0, /*terminated=*/true);
    EXPECT_NEAR(FrobeniusNorm(learner_.head_delta), 0.125, 1e-6);
  }
}

TEST_F(LearnerTest, DriftStaysWithinItsBound) {
  const LearningOptions options = {
      .modulator = Modulator::kTarget, .learning_rate = 1.0, .max_drift = 0.25};
  learner_ = NewLearner(options);
  Play(options, 200, /*target_return=*/1e6);
  EXPECT_NEAR(Drift(), 0.25, 1e-7);
  EXPECT_EQ(learner_.updates, 200);
  const Eigen::VectorXf before = learner_.head_delta;
  Play(options, 1, /*target_return=*/1e6);
  EXPECT_NE(learner_.head_delta, before);  // the update moves along the bound
  EXPECT_NEAR(Drift(), 0.25, 1e-7);
}

TEST_F(LearnerTest, NonFiniteUpdatesAreRefusedAndForgotten) {
  const LearningOptions options = {.modulator = Modulator::kTarget};
  learner_ = NewLearner(options);
  Play(options, 3, 9.0);
  const Eigen::VectorXf before = learner_.head_delta;
  ActionChoice choice =
      ChooseAction(policy_.weights.head, policy_.action_space, ReadoutAt(0), {}, 0);
  const std::vector<float> broken = {std::numeric_limits<float>::quiet_NaN(), 0.0f, 0.0f};
  EXPECT_EQ(learner_.OnDecision(options, policy_, choice, broken, 9.0, 0.0),
            UpdateOutcome::kNonFinite);
  EXPECT_EQ(learner_.head_delta, before);
  EXPECT_EQ(learner_.rejected, 1);
  EXPECT_EQ(learner_.OnDecision(options, policy_, choice, ReadoutAt(1), 9.0, 0.0),
            UpdateOutcome::kApplied);
}

TEST_F(LearnerTest, AbsurdReturnsLeaveAFiniteHeadWithinItsBound) {
  for (const Modulator modulator : {Modulator::kTarget, Modulator::kRealized}) {
    const LearningOptions options = {.modulator = modulator, .learning_rate = 0.1};
    learner_ = NewLearner(options);
    for (const double reward : {1e30, -3e38, 0.0, 3e38, -1e30}) {
      for (int t = 0; t < 20; ++t) {
        const ActionChoice choice =
            ChooseAction(HeadWith(policy_, learner_.head_delta), policy_.action_space, ReadoutAt(t),
                         {.sample = true}, t);
        const double rewards = t % 2 == 0 ? 0.0 : reward;
        learner_.OnDecision(options, policy_, choice, ReadoutAt(t), 9.0 - rewards, rewards);
      }
      learner_.OnEpisodeEnd(options, policy_, reward, /*terminated=*/true);
      learner_.StartEpisode(options);
      EXPECT_TRUE(std::isfinite(learner_.returns.mean));
      EXPECT_TRUE(std::isfinite(learner_.returns.variance));
      EXPECT_LE(Drift(), options.max_drift + 1e-6);
    }
  }
}

TEST_F(LearnerTest, AnotherEpisodeStartsWithEmptyTraces) {
  const LearningOptions options = {.modulator = Modulator::kRealized};
  learner_ = NewLearner(options);
  Play(options, 10, 9.0);
  learner_.OnEpisodeEnd(options, policy_, reward_, /*terminated=*/true);
  const Eigen::VectorXf learned = learner_.head_delta;
  const ReturnStatistics returns = learner_.returns;
  learner_.StartEpisode(options);
  Learner fresh = NewLearner(options);
  fresh.head_delta = learned;
  fresh.returns = returns;
  EXPECT_EQ(learner_.trace, fresh.trace);
  EXPECT_EQ(learner_.trace_sum, fresh.trace_sum);
  EXPECT_EQ(learner_.discounted_trace, fresh.discounted_trace);
  EXPECT_EQ(learner_.credit, fresh.credit);
  EXPECT_EQ(learner_.episode, fresh.episode);
  EXPECT_EQ(learner_.updates, 0);
}

TEST(ReturnStatisticsTest, OldEpisodesFadeFromAThousandDecisionsOn) {
  EpisodeReturns episode;
  for (const double reward : {1.0, 4.0, 5.0}) {
    episode.AddDecision(/*discount=*/1.0);
    episode.AddReward(reward);
  }
  ReturnStatistics returns = {.mean = 2.0, .variance = 9.0, .decisions = 1000.0};
  returns.Merge(episode);  // G = 10, 9, 5
  const double sum = 2.0 * 1000 + 10 + 9 + 5;
  const double squares = 1000 * (9.0 + 4.0) + 100 + 81 + 25;
  EXPECT_NEAR(returns.mean, sum / 1003, 1e-12);
  EXPECT_NEAR(returns.variance, squares / 1003 - returns.mean * returns.mean, 1e-9);
  EXPECT_EQ(returns.decisions, 1000.0);
}

TEST(ReturnStatisticsTest, DeviationIsNeverZero) {
  const ReturnStatistics returns = {.mean = 1.0, .variance = 0.0};
  EXPECT_EQ(returns.Normalized(1.0), 0.0);
  EXPECT_TRUE(std::isfinite(returns.Normalized(2.0)));
}

TEST(LearningOptionsTest, RefusalsNameTheField) {
  const auto refuse = [](const LearningOptions& options, const ActionSpace& space,
                         const std::string& message) {
    const absl::Status status = options.Validate(space, {});
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(status.message()), HasSubstr(message));
  };
  const ActionSpace discrete = ActionSpace::Discrete(2);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double infinity = std::numeric_limits<double>::infinity();
  refuse({.learning_rate = 0}, discrete,
         "learning.learning_rate: expected a finite number above 0");
  refuse({.learning_rate = infinity}, discrete, "received inf");
  refuse({.trace_decay = 1.5}, discrete,
         "learning.trace_decay: expected a number from 0 to 1, received 1.5");
  refuse({.trace_decay = nan}, discrete, "learning.trace_decay: expected");
  refuse({.discount = -0.1}, discrete, "learning.discount: expected a number from 0 to 1");
  refuse({.guard_margin = -1}, discrete, "learning.guard_margin: expected a finite number of at");
  refuse({.clip = -1}, discrete, "learning.clip: expected a finite number above 0");
  refuse({.max_drift = nan}, discrete, "learning.max_drift: expected a finite number above 0");
  const ActionSpace box = ActionSpace::Box({-1}, {1});
  refuse({}, box, "learning.rule: expected hebbian or hebbian_action, or action_selection SAMPLE");
  EXPECT_TRUE(LearningOptions().Validate(box, {.sample = true}).ok());
  EXPECT_TRUE(LearningOptions({.rule = Rule::kHebbian}).Validate(box, {}).ok());
  EXPECT_TRUE(LearningOptions({.rule = Rule::kHebbianAction}).Validate(box, {}).ok());
}

}  // namespace
}  // namespace spikeserve
