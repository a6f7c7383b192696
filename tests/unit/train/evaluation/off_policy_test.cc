#include "train/evaluation/off_policy.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <vector>

namespace spikeserve {
namespace {

using ::testing::DoubleNear;
using ::testing::Each;

// A task of two steps with the actions 0 and 1: the second reward depends on both actions.
constexpr double kReward[2][2] = {{1.0, -2.0}, {0.5, 4.0}};
constexpr double kRecorded = 0.4;  // probability of action 1

OffPolicyEpisode Make(size_t unit, int first, int second, double fresh) {
  OffPolicyEpisode episode = {.unit = unit};
  episode.rewards = {static_cast<double>(first), kReward[first][second]};
  episode.state = RowMajorMatrix<double>{{0.0, 0.0, 3.0}, {first - 0.5, 1.0, 2.0}};
  episode.taken = episode.recorded = episode.evaluated = RowMajorMatrix<double>::Zero(2, 2);
  for (const int t : {0, 1}) {
    const int action = t == 0 ? first : second;
    episode.taken(t, action) = 1.0;
    episode.recorded.row(t) << 1.0 - kRecorded, kRecorded;
    episode.evaluated.row(t) << 1.0 - fresh, fresh;
    episode.log_ratios.push_back(
        std::log(episode.evaluated(t, action) / episode.recorded(t, action)));
  }
  return episode;
}

double ReturnOf(double p) {
  double value = p;
  for (const int a : {0, 1}) {
    for (const int b : {0, 1}) value += (a ? p : 1 - p) * (b ? p : 1 - p) * kReward[a][b];
  }
  return value;
}

TEST(OffPolicy, EveryEpisodeAsOftenAsItIsProbableGivesTheExactReturn) {
  std::vector<OffPolicyEpisode> episodes;
  for (const int a : {0, 1}) {
    for (const int b : {0, 1}) {
      // Of 100 episodes, by the probability 0.4 of action 1.
      const int count = (a ? 2 : 3) * (b ? 2 : 3) * 4;
      for (int i = 0; i < count; ++i) episodes.push_back(Make(episodes.size(), a, b, 0.7));
    }
  }
  const OffPolicyEvaluation result = EvaluateOffPolicy(episodes);
  EXPECT_NEAR(result.recorded_return, ReturnOf(kRecorded), 1e-12);
  for (const auto* estimate : {&result.importance_sampling, &result.doubly_robust}) {
    // The doubly robust estimate has one Q for the even units and one for the odd ones.
    EXPECT_NEAR(estimate->new_return.value, ReturnOf(0.7), 0.02);
    EXPECT_NEAR(estimate->difference.value, ReturnOf(0.7) - ReturnOf(kRecorded), 0.04);
  }
  EXPECT_NEAR(result.importance_sampling.new_return.value, ReturnOf(0.7), 1e-12);
  // E[w]^2 / E[w^2] of two steps.
  const double square = 0.49 / 0.4 + 0.09 / 0.6;
  EXPECT_NEAR(result.effective(), 100.0 / (square * square), 1e-9);
  EXPECT_NEAR(result.effective_by_step[0], 100.0 / square, 1e-9);
}

std::vector<OffPolicyEpisode> Draw(std::mt19937_64& random, int count, double fresh) {
  std::bernoulli_distribution action(kRecorded);
  std::vector<OffPolicyEpisode> episodes;
  for (int i = 0; i < count; ++i) {
    const int first = action(random), second = action(random);
    episodes.push_back(Make(static_cast<size_t>(i), first, second, fresh));
  }
  return episodes;
}

TEST(OffPolicy, TheIntervalCoversInNineteenOfTwenty) {
  std::mt19937_64 random(7);
  constexpr int kRuns = 400;
  int covered = 0, sampled = 0;
  double robust_width = 0.0, sampling_width = 0.0;
  for (int run = 0; run < kRuns; ++run) {
    const OffPolicyEvaluation result = EvaluateOffPolicy(Draw(random, 200, 0.6));
    const double real = ReturnOf(0.6) - ReturnOf(kRecorded);
    const auto covers = [&](const OffPolicyInterval& of) {
      return of.low <= real && real <= of.high;
    };
    covered += covers(result.doubly_robust.difference);
    sampled += covers(result.importance_sampling.difference);
    robust_width += result.doubly_robust.difference.high - result.doubly_robust.difference.low;
    sampling_width +=
        result.importance_sampling.difference.high - result.importance_sampling.difference.low;
  }
  EXPECT_GE(covered, 0.93 * kRuns);
  EXPECT_GE(sampled, 0.93 * kRuns);
  EXPECT_LT(robust_width, 0.9 * sampling_width);
}

TEST(OffPolicy, TheRecordedPolicyItselfDiffersByNothing) {
  std::mt19937_64 random(7);
  const OffPolicyEvaluation result = EvaluateOffPolicy(Draw(random, 100, kRecorded));
  EXPECT_THAT(result.weights, Each(DoubleNear(1.0, 1e-12)));
  EXPECT_NEAR(result.doubly_robust.difference.value, 0.0, 1e-9);
  EXPECT_NEAR(result.importance_sampling.new_return.value, result.recorded_return, 1e-9);
  EXPECT_TRUE(result.can_tell());
}

TEST(OffPolicy, FewEffectiveEpisodesOrUnitsCannotTell) {
  std::mt19937_64 random(7);
  EXPECT_EQ(EvaluateOffPolicy(Draw(random, 200, 0.97)).verdict(), "cannot tell");
  auto episodes = Draw(random, 200, 0.6);
  EXPECT_EQ(EvaluateOffPolicy(episodes).verdict(), "better");
  for (auto& episode : episodes) episode.unit %= kFewestUnits - 1;
  EXPECT_EQ(EvaluateOffPolicy(episodes).verdict(), "cannot tell");
  EXPECT_EQ(EvaluateOffPolicy(Draw(random, 200, 0.2)).verdict(), "worse");
}

}  // namespace
}  // namespace spikeserve
