#include "server/rollouts/rollout_judge.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "server/rollouts/evidence_total.h"
#include "server/rollouts/sequential_test.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::SizeIs;
using Kind = RolloutVerdict::Kind;

const std::vector<RolloutCondition> kReturnOnly = {{RolloutMeasure::kReturn, 0.0}};
constexpr char kTenant[] = "";
constexpr PlausibleReturns kAnyReturn;
const double kAnyRange = kAnyReturn.TrainedRange();

void Decide(SessionListener& listener, double compute_seconds) {
  Session session;
  session.last_answer.emplace().compute_seconds = compute_seconds;
  listener.OnDecision(session, {});
}

void EndEpisode(SessionListener& listener, double episode_return) {
  EndedEpisode ended;
  ended.summary.episode_return = episode_return;
  Session session;
  session.last_end = std::make_shared<const EndedEpisode>(ended);
  listener.OnEpisodeEnd(session, /*contribution=*/nullptr);
}

// One version of a simulated roll-out.
class Arm {
 public:
  explicit Arm(const PlausibleReturns& plausible = kAnyReturn) {
    evidence_.Watch({}, /*most_per_session=*/4, plausible);
  }

  // Plays one session with these returns.
  void Play(const std::vector<double>& returns, const std::string& tenant = kTenant) {
    const auto session = evidence_.NewSession(tenant);
    for (const double value : returns) {
      Decide(*session, /*compute_seconds=*/1e-4);
      EndEpisode(*session, value);
    }
  }
  void Fail(const std::string& tenant = kTenant) { evidence_.NewSession(tenant)->OnFailure(); }

  VersionEvidence& evidence() { return evidence_; }
  VersionEvidence::Counts Read() const { return evidence_.Read(); }

 private:
  VersionEvidence evidence_;
};

RolloutVerdict JudgeReturns(const Arm& fresh, const Arm& stable) {
  return JudgeRollout(kReturnOnly, fresh.Read(), stable.Read(), kAnyRange);
}

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

// What the package confseq 0.0.11 computes, by its normal_log_mixture(s, v,
// v_opt=25.315438421184947, alpha_opt=0.05, is_one_sided=True), whose v_opt is that of effects of
// scale 0.5, with s the difference in deviations and v = 1, both divided by 1 / new_count + 1 /
// stable_count.
TEST(SequentialTest, EqualsConfseq) {
  const std::vector<std::pair<Comparison, double>> cases = {
      {{1.3, 4.0, 9.0, 40, 25}, 1.31710782029929},
      {{0.2, 1.0, 1.0, 100, 100}, 0.226945328897684},
      {{-0.5, 1.0, 2.0, 150, 300}, -3.3501409499275},
      {{5.0, 2500.0, 1600.0, 256, 20000}, -0.196585720486791},
      {{0.4, 0.21, 0.25, 1000, 120}, 32.6591518518031}};
  for (const auto& [comparison, expected] : cases) {
    EXPECT_NEAR(LogWorseRatio(comparison, /*scale=*/1.0), expected, 1e-12);
  }
}

// What confseq 0.0.11 computes: the logarithm of the mean of betting_mart(x, m) over the stakes s,
// with theta=1, trunc_scale=1 and the constant bets s / m; of the new version for 1 - x and 1 - m,
// added to that of the stable version, at the least of all m.
TEST(BettingTest, EqualsConfseq) {
  const std::vector<ObservedValue> fresh = {{0.2}, {0.4}, {0.1}, {0.5}, {0.3}, {0.2}, {0.45}};
  const std::vector<ObservedValue> stable = {{0.7}, {0.9}, {0.6}, {0.8}, {0.75}, {1.0}};
  EXPECT_NEAR(LogBettingRatio(fresh, stable, 0.0), 1.1218506686222218, 1e-12);
  EXPECT_NEAR(LogBettingRatio(fresh, stable, 0.1), 0.7690228102869591, 1e-12);
  EXPECT_NEAR(LogBettingRatio({{{0.0, 15}, {1.0, 10}}}, {{{1.0, 30}, {0.0, 1}}}, 0.01),
              6.256559734050466, 1e-12);
  EXPECT_EQ(LogBettingRatio({}, stable, 0.0), 0.0);
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

TEST(TrimmedMean, LeavesOutATenthAtEachEnd) {
  std::vector<double> values = {-1e6, 1, 2, 3, 4, 5, 6, 7, 8, 1e6};
  const TrimmedMean mean = TrimmedMeanOf(values);
  EXPECT_EQ(mean.count, 10);
  EXPECT_DOUBLE_EQ(mean.mean, 4.5);
  // Winsorized: 1, 1, 2, ..., 8, 8. Its squares about 4.5, over h (h - 1) with h = 8 kept values.
  EXPECT_NEAR(mean.variance, 10 * (42.0 + 2 * 12.25) / (8 * 7), 1e-12);
  std::vector<double> two = {1.0, 3.0};
  EXPECT_DOUBLE_EQ(TrimmedMeanOf(two).mean, 2.0);
  std::vector<double> none;
  EXPECT_EQ(TrimmedMeanOf(none).count, 0);
}

// Simulates roll-outs that are judged after every pair of sessions, and returns the share of those
// that end with `kind`. `play(random, fresh, stable)` adds sessions to both versions.
double ShareOfRollouts(
    Kind kind, int rollouts, int rounds,
    const std::function<void(std::mt19937_64& random, Arm& fresh, Arm& stable)>& play) {
  std::mt19937_64 random(7);
  int ended = 0;
  for (int rollout = 0; rollout < rollouts; ++rollout) {
    Arm fresh, stable;
    for (int round = 0; round < rounds; ++round) {
      play(random, fresh, stable);
      const Kind found = JudgeReturns(fresh, stable).kind;
      if (found == kind) ++ended;
      if (found == kind || found == Kind::kWorse) break;
    }
  }
  return static_cast<double>(ended) / rollouts;
}

double Normal(std::mt19937_64& random, double mean, double deviation) {
  return std::normal_distribution<double>(mean, deviation)(random);
}

// The promise of the test: it is looked at after every session, and still aborts at most 5 % of the
// roll-outs of versions that are equal, whatever their returns are like.
TEST(RolloutJudge, EqualVersionsAreNotAborted) {
  const auto normal = [](std::mt19937_64& random) { return Normal(random, 200.0, 50.0); };
  const auto often_fails = [](std::mt19937_64& random) {
    return std::bernoulli_distribution(0.7)(random) ? 500.0 : Normal(random, 50.0, 10.0);
  };
  const auto heavy_tailed = [](std::mt19937_64& random) {
    return -std::lognormal_distribution<double>(3.0, 1.5)(random);
  };
  const std::vector<std::function<double(std::mt19937_64&)>> kinds = {normal, often_fails,
                                                                      heavy_tailed};
  for (size_t kind = 0; kind < kinds.size(); ++kind) {
    const double aborted = ShareOfRollouts(Kind::kWorse, 300, 200,
                                           [&](std::mt19937_64& random, Arm& fresh, Arm& stable) {
                                             fresh.Play({kinds[kind](random)});
                                             // Three times the sessions, as in a step of 25 %.
                                             for (int i = 0; i < 3; ++i)
                                               stable.Play({kinds[kind](random)});
                                           });
    RecordProperty("aborted_" + std::to_string(kind), std::to_string(aborted));
    EXPECT_LE(aborted, kFalseAborts) << kind;
  }
}

// A tenth of the new version's sessions earns all of the difference, which a trimmed mean leaves
// out. The means are equal, and as long as sessions are few, that is what counts.
TEST(RolloutJudge, RareSuccessesOfFewSessionsAreNotLeftOut) {
  constexpr int kRollouts = 40, kSessions = 9;
  std::mt19937_64 random(7);
  int aborted = 0;
  for (int rollout = 0; rollout < kRollouts; ++rollout) {
    Arm fresh, stable;
    Kind found = Kind::kNotWorse;
    for (int64_t played = 0; played + kSessions < kFewestNormal; played += kSessions) {
      for (int session = 0; session < kSessions; ++session) {
        fresh.Play({std::bernoulli_distribution(0.1)(random) ? 400.0 : Normal(random, 178.0, 5.0)});
        stable.Play({Normal(random, 200.2, 5.0)});
      }
      found = JudgeRollout(kReturnOnly, fresh.Read(), stable.Read(), /*trained_range=*/500.0).kind;
      if (found == Kind::kWorse) break;
    }
    aborted += found == Kind::kWorse;
  }
  EXPECT_LE(aborted, kRollouts * kFalseAborts);
}

// The episodes of one session depend on each other: a robot has its own wear and its own place.
TEST(RolloutJudge, EpisodesOfASessionAreNoIndependentEvidence) {
  const double aborted =
      ShareOfRollouts(Kind::kWorse, 300, 200, [](std::mt19937_64& random, Arm& fresh, Arm& stable) {
        for (Arm* arm : {&fresh, &stable}) {
          const double robot = Normal(random, 200.0, 50.0);
          std::vector<double> returns(20);
          for (double& value : returns) value = Normal(random, robot, 5.0);
          arm->Play(returns);
        }
      });
  EXPECT_LE(aborted, kFalseAborts);
}

// Tenants have other tasks, and other shares of both versions.
TEST(RolloutJudge, TenantsThatDifferAreNoDifferenceOfTheVersions) {
  const auto play = [](std::mt19937_64& random, Arm& fresh, Arm& stable) {
    fresh.Play({Normal(random, 20.0, 5.0)}, "hard");
    stable.Play({Normal(random, 20.0, 5.0)}, "hard");
    for (int i = 0; i < 8; ++i) stable.Play({Normal(random, 400.0, 5.0)}, "easy");
    if (std::bernoulli_distribution(0.5)(random)) fresh.Play({Normal(random, 400.0, 5.0)}, "easy");
    stable.Play({Normal(random, 90.0, 5.0)}, "idle");
  };
  EXPECT_LE(ShareOfRollouts(Kind::kWorse, 200, 100, play), kFalseAborts);
  EXPECT_LE(ShareOfRollouts(Kind::kDisputed, 200, 100, play), 2 * kFalseAborts);
}

TEST(RolloutJudge, AWorseVersionIsFound) {
  // 10 % worse, where one session's return deviates by 25 %.
  const auto play = [](std::mt19937_64& random, Arm& fresh, Arm& stable) {
    fresh.Play({Normal(random, 180.0, 50.0)});
    stable.Play({Normal(random, 200.0, 50.0)});
  };
  EXPECT_GE(ShareOfRollouts(Kind::kWorse, 200, 300, play), 0.9);
  Arm fresh, stable;
  std::mt19937_64 random(7);
  for (int session = 0; session < 300; ++session) {
    fresh.Play({Normal(random, 185.0, 20.0)});
    stable.Play({Normal(random, 200.0, 20.0)});
  }
  EXPECT_THAT(JudgeReturns(fresh, stable).reason, HasSubstr("return is worse: mean return 18"));
  EXPECT_EQ(JudgeReturns(stable, fresh).kind, Kind::kNotWorse);
  EXPECT_EQ(
      JudgeRollout({{RolloutMeasure::kReturn, 0.1}}, fresh.Read(), stable.Read(), kAnyRange).kind,
      Kind::kNotWorse);
}

// Attacks: `liars` of every ten sessions of the new version tell `lie`.
double ShareWithLiars(Kind kind, double truth, double lie, int liars) {
  return ShareOfRollouts(kind, 200, 30, [=](std::mt19937_64& random, Arm& fresh, Arm& stable) {
    for (int session = 0; session < 10; ++session) {
      fresh.Play({session < liars ? lie : Normal(random, truth, 20.0)});
      stable.Play({Normal(random, 200.0, 20.0)});
    }
  });
}

TEST(RolloutJudge, OneSessionInTenNeitherAbortsNorHides) {
  EXPECT_LE(ShareWithLiars(Kind::kWorse, /*truth=*/200.0, /*lie=*/200.0, 0), kFalseAborts);
  EXPECT_EQ(ShareWithLiars(Kind::kWorse, /*truth=*/150.0, /*lie=*/1e6, 1), 1.0);
  // A lie that is left out costs what the honest sessions at the other end would have added.
  EXPECT_LE(ShareWithLiars(Kind::kWorse, /*truth=*/215.0, /*lie=*/-1e6, 1), kFalseAborts);
}

TEST(RolloutJudge, SessionsWithErrorsAreCountedOnce) {
  Arm fresh, stable;
  for (int session = 0; session < 100; ++session) {
    stable.Play({1.0});
    if (session % 4 != 0) {
      fresh.Play({1.0});
      continue;
    }
    const auto failing = fresh.evidence().NewSession(kTenant);
    for (int error = 0; error < 3; ++error) failing->OnFailure();
  }
  EXPECT_EQ(fresh.Read()[kTenant].failed_sessions, 25);
  EXPECT_EQ(fresh.Read()[kTenant].sessions, 100);
  const auto judge = [&](double margin) {
    return JudgeRollout({{RolloutMeasure::kErrors, margin}}, fresh.Read(), stable.Read(),
                        kAnyRange);
  };
  EXPECT_THAT(judge(0.01).reason,
              HasSubstr("errors is worse: 25 of 100 sessions had errors, stable version 0 of 100"));
  EXPECT_EQ(judge(0.25).kind, Kind::kNotWorse);
}

// Plays 20 sessions of 500 decisions each, of which stable does one of 200 and fresh one of 20 four
// times as slowly as the others.
void PlayWithSlowTails(Arm& fresh, Arm& stable, double seconds) {
  for (int session = 0; session < 20; ++session) {
    const auto old = stable.evidence().NewSession(kTenant);
    const auto slow = fresh.evidence().NewSession(kTenant);
    for (int decision = 0; decision < 500; ++decision) {
      Decide(*old, decision % 200 == 0 ? 4 * seconds : seconds);
      Decide(*slow, decision % 20 == 0 ? 4 * seconds : seconds);
    }
  }
}

TEST(RolloutJudge, ASlowTailIsFoundAndItsMarginIsAllowed) {
  Arm fresh, stable;
  PlayWithSlowTails(fresh, stable, 0.01);
  EXPECT_NEAR(stable.Read()[kTenant].durations.Quantile(0.99), 0.01, 0.001);
  const auto judge = [&](const Arm& judged, double margin) {
    return JudgeRollout({{RolloutMeasure::kP99, margin}}, judged.Read(), stable.Read(), kAnyRange);
  };
  EXPECT_THAT(judge(fresh, 0.25).reason, HasSubstr("p99 is worse"));
  EXPECT_EQ(judge(fresh, 3.0).kind, Kind::kNotWorse);
  EXPECT_EQ(judge(stable, 0.25).kind, Kind::kNotWorse);
}

TEST(RolloutJudge, ATailThatIsLessThanFiveMillisecondsSlowerIsNoReason) {
  Arm fresh, stable;
  PlayWithSlowTails(fresh, stable, 0.0015);
  for (const double margin : {0.0, 0.25}) {
    EXPECT_EQ(
        JudgeRollout({{RolloutMeasure::kP99, margin}}, fresh.Read(), stable.Read(), kAnyRange).kind,
        Kind::kNotWorse);
  }
}

TEST(VersionEvidence, CountsOnlyWhileItIsWatched) {
  VersionEvidence evidence;
  EXPECT_EQ(evidence.NewSession(kTenant), nullptr);
  VersionEvidence::Counts start;
  start[kTenant] = {{.sessions = 1, .episodes = 2, .returning = 1, .returns = {{2, 3.0}}}};
  evidence.Watch(start, /*most_per_session=*/4, kAnyReturn);
  const auto session = evidence.NewSession(kTenant);
  Decide(*session, 1e-3);
  EndEpisode(*session, 5.0);
  EndEpisode(*session, 6.0);
  EXPECT_THAT(evidence.Read()[kTenant].returns,
              ElementsAre(SessionReturn{2, 3.0}, SessionReturn{2, 5.5}));
  evidence.Stop();
  EndEpisode(*session, 6.0);
  EXPECT_EQ(evidence.Read()[kTenant].episodes, 4);
  evidence.Watch({}, /*most_per_session=*/4, kAnyReturn);
  EndEpisode(*session, 6.0);  // of the roll-out before
  EXPECT_TRUE(evidence.Read().empty());
}

TEST(VersionEvidence, KeepsARandomSampleOfTheSessions) {
  Arm arm;
  constexpr int kSessions = 20'000;
  for (int session = 0; session < kSessions; ++session) arm.Play({session * 1.0});
  const VersionEvidence::TenantCounts counts = arm.Read()[kTenant];
  EXPECT_EQ(counts.returning, kSessions);
  EXPECT_THAT(counts.returns, SizeIs(VersionEvidence::kMostSampled));
  const EvidenceTotal total = TotalOf(arm.Read());
  // Five standard errors of the mean of 256 values that are spread evenly.
  EXPECT_NEAR(total.returns.mean, kSessions / 2.0, 5.0 * kSessions / std::sqrt(12.0 * 256.0));
}

// The sample changes all the time, so the judge gets new chances to err for as long as a roll-out
// lasts.
TEST(RolloutJudge, ALongRolloutOfEqualVersionsIsNotAborted) {
  const double aborted =
      ShareOfRollouts(Kind::kWorse, 40, 500, [](std::mt19937_64& random, Arm& fresh, Arm& stable) {
        for (int session = 0; session < 10; ++session) {
          fresh.Play({Normal(random, 200.0, 50.0)});
          stable.Play({Normal(random, 200.0, 50.0)});
        }
      });
  EXPECT_LE(aborted, kFalseAborts);
}

}  // namespace
}  // namespace spikeserve
