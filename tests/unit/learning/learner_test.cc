// The equations are compared over the wire, by tests/python/learning/test_learning.py.
#include "core/learning/learner.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "core/learning/correction_runs.h"

namespace spikeserve {
namespace {

constexpr size_t kOutputs = 2;
constexpr size_t kInputs = 3;

Policy LearnerPolicy() {
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

class LearnerTest : public ::testing::Test {
 protected:
  Learner NewLearner(const LearningOptions& options) {
    return Learner::New(options, policy_, Eigen::VectorXf::Zero(kOutputs * kInputs));
  }

  // Plays `steps` decisions with the rewards 0.3, 0.6, 0.9, 0.3 and so on.
  void Play(const LearningOptions& options, int steps, double target_return) {
    double rewards = 0.0;
    for (int t = 0; t < steps; ++t) {
      const ActionChoice choice =
          ChooseAction(HeadWith(policy_, learner_.head_delta), policy_.action_space, ReadoutAt(t),
                       {.sample = true}, 1000 + t);
      learner_.OnDecision(options, policy_, choice, ReadoutAt(t), target_return - rewards, reward_);
      reward_ = 0.3 * (t % 3 + 1);
      rewards += reward_;
    }
  }

  Policy policy_ = LearnerPolicy();
  Learner learner_;
  double reward_ = 0.0;  // of the last decision
};

// What is kept of an episode makes the update that its final rewards would have made in time.
TEST_F(LearnerTest, RewardsThatComeLateTeachTheSame) {
  const LearningOptions in_time = {.discount = 0.9};
  LearningOptions awaits = in_time;
  awaits.verdict_seconds = 60.0;
  Learner expected = NewLearner(in_time);
  Learner late = NewLearner(awaits);
  std::vector<double> rewards;
  for (int t = 0; t < 12; ++t) {
    const double reward = t == 0 ? 0.0 : 0.1 * (t % 5);
    if (t > 0) rewards.push_back(reward);
    if (t == 7) {
      expected.OnSkipped(in_time, reward);
      late.OnSkipped(awaits, -3.0);
      continue;
    }
    const ActionChoice choice = ChooseAction(policy_.weights.head, policy_.action_space,
                                             ReadoutAt(t), {.sample = true}, 1000 + t);
    expected.OnDecision(in_time, policy_, choice, ReadoutAt(t), 0.0, reward);
    late.OnDecision(awaits, policy_, choice, ReadoutAt(t), 0.0, -3.0);
    if (t % 4 != 1) continue;
    const Action other = {.discrete = 1 - choice.action.discrete, .continuous = {}};
    expected.OnExecuted(in_time, policy_, {}, choice.logits, choice.action, other, 0.0);
    late.OnExecuted(awaits, policy_, {}, choice.logits, choice.action, other, 0.0);
  }
  EXPECT_EQ(late.trace.norm(), 0.0f);
  EXPECT_EQ(expected.OnEpisodeEnd(in_time, policy_, 4.0, false), UpdateOutcome::kApplied);
  ASSERT_TRUE(late.AwaitVerdict(/*reward=*/-3.0, {}));
  EpisodeFactors factors = late.waiting[0]->factors;
  EXPECT_EQ(factors.rewards, std::vector<double>(12, -3.0));
  factors.rewards = rewards;
  late.Recall(awaits, factors);
  EXPECT_EQ(late.OnEpisodeEnd(awaits, policy_, 4.0, false), UpdateOutcome::kApplied);
  EXPECT_EQ(late.head_delta, expected.head_delta);
  EXPECT_EQ(late.returns, expected.returns);
  EXPECT_GT(late.head_delta.norm(), 0.0f);
}

TEST_F(LearnerTest, AnEpisodeOfTooManyStepsIsLearnedFromAtItsEnd) {
  const LearningOptions awaits = {.verdict_seconds = 60.0};
  const auto steps = static_cast<int>(Learner::kMostKept) + 3;
  learner_ = NewLearner(awaits);
  Play(awaits, steps, 10.0);
  EXPECT_FALSE(learner_.AwaitVerdict(reward_, {}));
  learner_.OnEpisodeEnd(awaits, policy_, reward_, true);
  const Eigen::VectorXf late = learner_.head_delta;
  learner_ = NewLearner({});
  reward_ = 0.0;
  Play({}, steps, 10.0);
  learner_.OnEpisodeEnd({}, policy_, reward_, true);
  EXPECT_EQ(late, learner_.head_delta);
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

TEST(ReturnStatisticsTest, DeviationIsNeverZero) {
  const ReturnStatistics returns = {.mean = 1.0, .variance = 0.0};
  EXPECT_EQ(returns.Normalized(1.0), 0.0);
  EXPECT_TRUE(std::isfinite(returns.Normalized(2.0)));
}

constexpr double kBegin = 1e9;  // seconds since 1970

// A head that operators change, by a second each.
struct Taught {
  CorrectionRuns runs;
  Eigen::VectorXf head = Eigen::VectorXf::Zero(3);
  Corrections measured;
  double now = kBegin;

  void Correct(const char* operator_id, float change, int times) {
    for (int i = 0; i < times; ++i) {
      const Corrections before = measured;
      ++measured.steps;
      measured.Measure(1.0, 2.0, 3.0);
      runs.Add(operator_id, now, head, before);
      head.array() += change;
      now += 1.0;
    }
  }
};

TEST(CorrectionRunsTest, TheLastOperatorIsTakenOutBitForBit) {
  Taught taught;
  taught.Correct("ann", 0.1f, 5);
  const Taught before = taught;
  taught.Correct("bob", 0.3f, 40);  // in three runs
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), 40);
  EXPECT_EQ(taught.head, before.head);
  EXPECT_EQ(taught.measured.error, before.measured.error);
  EXPECT_EQ(taught.measured.steps, 45);  // happened
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), 0);
  EXPECT_EQ(taught.runs.Undo("ann", kBegin, &taught.head, &taught.measured), 5);
  EXPECT_EQ(taught.head, Eigen::VectorXf::Zero(3));
}

TEST(CorrectionRunsTest, WhatOthersHaveTaughtStays) {
  Taught taught;
  taught.Correct("ann", 1.0f, 2);
  taught.Correct("bob", 10.0f, 2);
  taught.Correct("ann", 2.0f, 1);
  taught.Correct("bob", 20.0f, 1);
  EXPECT_EQ(taught.runs.Undo("eve", kBegin, &taught.head, &taught.measured), 0);
  EXPECT_EQ(taught.head[0], 44.0f);
  EXPECT_EQ(taught.runs.Undo("ann", kBegin + 4.0, &taught.head, &taught.measured), 1);
  EXPECT_EQ(taught.head[0], 42.0f);
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), 3);
  EXPECT_EQ(taught.head[0], 2.0f);
  EXPECT_EQ(taught.runs.Undo("ann", kBegin, &taught.head, &taught.measured), 2);
  EXPECT_EQ(taught.head[0], 0.0f);
}

TEST(CorrectionRunsTest, WhatIsForgottenIsNotUndone) {
  Taught taught;
  taught.Correct("ann", 1.0f, 1);
  for (size_t i = 0; i < CorrectionRuns::kMost; ++i) {
    taught.Correct(i % 2 == 0 ? "bob" : "eve", 10.0f, 1);
  }
  EXPECT_EQ(taught.runs.runs.size(), CorrectionRuns::kMost);
  const Eigen::VectorXf head = taught.head;
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), std::nullopt);
  EXPECT_EQ(taught.head, head);
  EXPECT_EQ(taught.runs.Undo("bob", kBegin + 1.0, &taught.head, &taught.measured), 4);
  taught.runs.Forget();
  EXPECT_EQ(taught.runs.Undo("eve", kBegin + 1.0, &taught.head, &taught.measured), std::nullopt);
  EXPECT_EQ(taught.runs.Undo("eve", taught.now, &taught.head, &taught.measured), 0);
}

}  // namespace
}  // namespace spikeserve
