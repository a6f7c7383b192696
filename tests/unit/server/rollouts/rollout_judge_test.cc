#include "server/rollouts/rollout_judge.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "server/rollouts/sequential_test.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using ::testing::IsEmpty;

// One arm of a simulated roll-out.
class Arm {
 public:
  Arm() { evidence_.Watch({}); }
  VersionEvidence& evidence() { return evidence_; }
  VersionEvidence::Counts Read() const { return evidence_.Read(); }

 private:
  VersionEvidence evidence_;
};

TEST(SequentialTest, EqualsTheIntegralOverTheMixture) {
  const Comparison comparison = {.difference = 1.3,
                                 .new_variance = 4.0,
                                 .stable_variance = 9.0,
                                 .new_count = 40,
                                 .stable_count = 25};
  const double variance = 4.0 / 40 + 9.0 / 25;
  const double unit = 1.0 / 40 + 1.0 / 25;
  const double deviation = std::sqrt(variance / unit);
  // Sums the likelihood ratios of effects with their half-normal density of scale 0.5.
  double ratio = 0.0;
  constexpr double kStep = 1e-4;
  for (double effect = kStep / 2; effect < 6.0; effect += kStep) {
    const double density =
        2.0 / (0.5 * std::sqrt(2.0 * M_PI)) * std::exp(-effect * effect / (2.0 * 0.25));
    const double z = comparison.difference / deviation;
    ratio += kStep * density * std::exp((z * effect - effect * effect / 2.0) / unit);
  }
  EXPECT_NEAR(LogWorseRatio(comparison, /*scale=*/1.0), std::log(ratio), 1e-6);
}

TEST(SequentialTest, StaysFiniteFarFromTheHypothesis) {
  Comparison comparison = {.difference = -1e6,
                           .new_variance = 1.0,
                           .stable_variance = 1.0,
                           .new_count = 1'000'000,
                           .stable_count = 1'000'000};
  EXPECT_LT(LogWorseRatio(comparison, 1.0), 0.0);
  EXPECT_TRUE(std::isfinite(LogWorseRatio(comparison, 1.0)));
  comparison.difference = 1e6;
  EXPECT_GT(LogWorseRatio(comparison, 1.0), 100.0);
  comparison.new_count = kFewestObservations - 1;
  EXPECT_LT(LogWorseRatio(comparison, 1.0), -1e300);
}

// The promise of the test: it is looked at after every episode, and still aborts at most 5 % of the
// roll-outs of versions that are equal.
TEST(RolloutJudge, LookingAllTheTimeDoesNotAbortEqualVersions) {
  std::mt19937_64 random(7);
  std::normal_distribution<double> returns(200.0, 50.0);
  constexpr int kRollouts = 400;
  int aborted = 0;
  for (int rollout = 0; rollout < kRollouts; ++rollout) {
    Arm fresh, stable;
    bool worse = false;
    for (int episode = 0; episode < 400 && !worse; ++episode) {
      fresh.evidence().CountEpisode(returns(random));
      stable.evidence().CountEpisode(returns(random));
      worse = !FindWorse({{RolloutMeasure::kReturn, 0.0}}, fresh.Read(), stable.Read()).empty();
    }
    aborted += worse ? 1 : 0;
  }
  EXPECT_LE(aborted, kRollouts * kFalseAborts);
}

TEST(RolloutJudge, AWorseReturnIsFoundAndItsMarginIsAllowed) {
  std::mt19937_64 random(7);
  std::normal_distribution<double> noise(0.0, 20.0);
  Arm fresh, stable;
  for (int episode = 0; episode < 300; ++episode) {
    fresh.evidence().CountEpisode(185.0 + noise(random));
    stable.evidence().CountEpisode(200.0 + noise(random));
  }
  EXPECT_THAT(FindWorse({{RolloutMeasure::kReturn, 0.0}}, fresh.Read(), stable.Read()),
              HasSubstr("return is worse: mean return 18"));
  EXPECT_THAT(FindWorse({{RolloutMeasure::kReturn, 0.1}}, fresh.Read(), stable.Read()), IsEmpty());
  EXPECT_THAT(FindWorse({{RolloutMeasure::kReturn, 0.0}}, stable.Read(), fresh.Read()), IsEmpty());
}

TEST(RolloutJudge, ReturnsThatNeverVaryAreCompared) {
  Arm fresh, stable;
  for (int episode = 0; episode < kFewestObservations; ++episode) {
    EXPECT_THAT(FindWorse(DefaultConditions(), fresh.Read(), stable.Read()), IsEmpty()) << episode;
    fresh.evidence().CountEpisode(499.0);
    stable.evidence().CountEpisode(500.0);
  }
  EXPECT_THAT(FindWorse(DefaultConditions(), fresh.Read(), stable.Read()),
              HasSubstr("mean return 499 over 20 episodes, stable version 500 over 20"));
  EXPECT_THAT(FindWorse(DefaultConditions(), stable.Read(), stable.Read()), IsEmpty());
}

TEST(RolloutJudge, SessionsWithErrorsAreCountedOnce) {
  Arm fresh, stable;
  for (int session = 0; session < 100; ++session) {
    const std::string id = std::to_string(session);
    fresh.evidence().CountSession();
    stable.evidence().CountSession();
    if (session % 4 != 0) continue;
    for (int error = 0; error < 3; ++error) fresh.evidence().CountFailure(id);
  }
  EXPECT_EQ(fresh.Read().failed_sessions, 25);
  EXPECT_THAT(FindWorse({{RolloutMeasure::kErrors, 0.01}}, fresh.Read(), stable.Read()),
              HasSubstr("errors is worse: 25 of 100 sessions had errors, stable version 0 of 100"));
  EXPECT_THAT(FindWorse({{RolloutMeasure::kErrors, 0.25}}, fresh.Read(), stable.Read()), IsEmpty());
}

TEST(RolloutJudge, ASlowTailIsFoundAndItsMarginIsAllowed) {
  Arm fresh, stable;
  for (int decision = 0; decision < 10'000; ++decision) {
    stable.evidence().CountDecision(decision % 200 == 0 ? 400e-6 : 100e-6);
    fresh.evidence().CountDecision(decision % 20 == 0 ? 400e-6 : 100e-6);
  }
  EXPECT_NEAR(stable.Read().durations.Quantile(0.99), 100e-6, 10e-6);
  EXPECT_THAT(FindWorse({{RolloutMeasure::kP99, 0.25}}, fresh.Read(), stable.Read()),
              HasSubstr("p99 is worse"));
  EXPECT_THAT(FindWorse({{RolloutMeasure::kP99, 3.0}}, fresh.Read(), stable.Read()), IsEmpty());
  EXPECT_THAT(FindWorse({{RolloutMeasure::kP99, 0.25}}, stable.Read(), stable.Read()), IsEmpty());
}

TEST(VersionEvidence, CountsOnlyWhileItIsWatched) {
  VersionEvidence evidence;
  evidence.CountEpisode(1.0);
  EXPECT_EQ(evidence.Read().episodes, 0);
  evidence.Watch({.episodes = 2, .return_mean = 3.0, .return_squares = 2.0});
  evidence.CountEpisode(6.0);
  EXPECT_EQ(evidence.Read().episodes, 3);
  EXPECT_DOUBLE_EQ(evidence.Read().return_mean, 4.0);
  EXPECT_DOUBLE_EQ(evidence.Read().return_variance(), 4.0);  // of 2, 4 and 6
  evidence.Stop();
  evidence.CountEpisode(6.0);
  EXPECT_EQ(evidence.Read().episodes, 3);
}

}  // namespace
}  // namespace spikeserve
