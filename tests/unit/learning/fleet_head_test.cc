#include "core/learning/fleet_head.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "core/learning/frobenius_norm.h"
#include "core/learning/held_out.h"

namespace spikeserve {
namespace {

constexpr Eigen::Index kSize = 6;

std::shared_ptr<const Policy> TestPolicy() {
  Policy policy;
  policy.action_space = ActionSpace::Discrete(2);
  policy.weights.head.weight = {.shape = {2, 3}, .values = {3.0f, -2.0f, 1.0f, 0.1f, 5.0f, -4.0f}};
  policy.weights.head.bias = {.shape = {2}, .values = {0.1f, -0.1f}};
  return std::make_shared<const Policy>(std::move(policy));
}

// Returns what session `i` contributes, whose elements are a few hundredths.
Eigen::VectorXf DeltaOf(int i) {
  Eigen::VectorXf delta(kSize);
  for (Eigen::Index j = 0; j < kSize; ++j) {
    delta[j] = 0.03f * std::sin(0.7f * static_cast<float>(i) + static_cast<float>(j));
  }
  return delta;
}

MergeOutcome Merge(FleetHead& fleet, const Eigen::VectorXf& delta, double episode_return) {
  return fleet.Merge({.delta = delta, .episode_return = episode_return}, absl::ZeroDuration());
}

void ExpectNear(const Eigen::VectorXf& actual, const Eigen::VectorXd& expected) {
  ASSERT_EQ(actual.size(), expected.size());
  for (Eigen::Index j = 0; j < actual.size(); ++j) {
    EXPECT_NEAR(actual[j], expected[j], FleetHead::kMergeTolerance) << j;
  }
}

// Runs 64 sessions, each on a thread that merges and reads.
TEST(FleetHeadTest, TheOrderOfContributionsDoesNotMatter) {
  constexpr int kSessions = 64, kEpisodes = 10;
  Eigen::VectorXd sum = Eigen::VectorXd::Zero(kSize);
  for (int i = 0; i < kSessions * kEpisodes; ++i) sum += DeltaOf(i).cast<double>();
  FleetHead fleet(TestPolicy());
  std::vector<std::thread> sessions;
  for (int session = 0; session < kSessions; ++session) {
    sessions.emplace_back([&fleet, session] {
      for (int i = 0; i < kEpisodes; ++i) {
        EXPECT_LE(fleet.Read()->drift, FleetOptions().max_drift + 1e-6);
        Merge(fleet, DeltaOf(session * kEpisodes + i), 10.0);
      }
    });
  }
  for (std::thread& session : sessions) session.join();
  ExpectNear(fleet.Read()->delta, sum);
  EXPECT_EQ(fleet.Read()->updates, kSessions * kEpisodes);
}

TEST(FleetHeadTest, NoContributionIsLongerThanTheClip) {
  FleetHead fleet(TestPolicy(), {.clip = 0.25, .max_drift = 1.0, .guard_margin = 0.02});
  Merge(fleet, Eigen::VectorXf::Constant(kSize, 1e30f), 10.0);
  EXPECT_NEAR(FrobeniusNorm(fleet.Read()->delta), 0.25, 1e-6);
}

TEST(FleetHeadTest, DriftStaysWithinItsBound) {
  FleetHead fleet(TestPolicy(), {.clip = 0.5, .max_drift = 0.1, .guard_margin = 0.02});
  for (int i = 0; i < 19; ++i) Merge(fleet, Eigen::VectorXf::Constant(kSize, 1.0f), 10.0);
  EXPECT_NEAR(fleet.Read()->drift, 0.1, 1e-6);
}

TEST(FleetHeadTest, NonFiniteContributionsAreRefused) {
  FleetHead fleet(TestPolicy());
  Merge(fleet, DeltaOf(1), 10.0);
  Eigen::VectorXf broken = DeltaOf(2);
  broken[3] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(Merge(fleet, broken, 10.0).update, UpdateOutcome::kNonFinite);
  EXPECT_EQ(fleet.Read()->delta, DeltaOf(1));
  EXPECT_EQ(fleet.Read()->rejected, 1);
}

// Returns contribution `i` of fifteen, at a fleet that gets worse for a while.
Contribution ContributionOf(int i) {
  Contribution contribution = {.contributor = std::string(1, static_cast<char>('a' + i % 15)),
                               .held_out = i % 15 == 2,
                               .delta = DeltaOf(i),
                               .episode_return = i < 60 || i > 100 ? 10.0 : 1.0};
  if (i % 15 == 4) contribution.operators = {"bob", "ann"};
  if (i % 15 == 5) contribution.operators = {"bob"};
  return contribution;
}

TEST(FleetHeadTest, AnUndoneOperatorWasNeverThere) {
  FleetHead fleet(TestPolicy()), without(TestPolicy());
  int64_t anns = 0;
  for (int i = 0; i < 200; ++i) {
    const absl::Duration now = absl::Seconds(i + 1);
    const Contribution contribution = ContributionOf(i);
    const bool is_anns = !contribution.operators.empty() && contribution.operators.back() == "ann";
    anns += i >= 49 && is_anns ? 1 : 0;
    fleet.Merge(contribution, now, 15);
    if (i < 49 || !is_anns) without.Merge(contribution, now, 15);
  }
  const auto taught = fleet.Read();
  EXPECT_EQ(fleet.Undo("eve", absl::Seconds(150), absl::Seconds(200)).undone, 0);
  EXPECT_EQ(fleet.Read(), taught);
  const MergeOutcome outcome = fleet.Undo("ann", absl::Seconds(150), absl::Seconds(200));
  EXPECT_EQ(outcome.undone, anns);
  const auto undone = fleet.Read(), expected = without.Read();
  EXPECT_NE(undone->delta, taught->delta);
  EXPECT_EQ(undone->delta, expected->delta);  // bit for bit
  EXPECT_EQ(outcome.drift, expected->drift);
  EXPECT_GT(undone->rollbacks, 0);
  EXPECT_EQ(undone->rollbacks, expected->rollbacks);
  EXPECT_EQ(undone->updates, expected->updates);
  EXPECT_EQ(undone->rejected, expected->rejected);
  EXPECT_EQ(fleet.Undo("ann", absl::Seconds(150), absl::Seconds(200)).undone, 0);
}

TEST(FleetHeadTest, WhatIsForgottenIsNotUndone) {
  FleetHead fleet(TestPolicy());
  const absl::Duration begin = absl::Seconds(1), later = begin + FleetHead::kKept;
  fleet.Merge({.operators = {"ann"}, .delta = DeltaOf(1)}, begin);
  fleet.Merge({.operators = {"bob"}, .delta = DeltaOf(2)}, later);
  fleet.Merge({.delta = DeltaOf(3)}, later + absl::Seconds(1));
  const auto taught = fleet.Read();
  const absl::Duration now = later + absl::Seconds(2);
  EXPECT_EQ(fleet.Undo("bob", now - begin, now).undone, -1);
  EXPECT_EQ(fleet.Read(), taught);
  EXPECT_EQ(fleet.Undo("bob", absl::Seconds(60), now).undone, 1);
  FleetHead without(TestPolicy());
  for (const int i : {1, 3}) without.Merge({.delta = DeltaOf(i)}, begin);
  EXPECT_EQ(fleet.Read()->delta, without.Read()->delta);
  fleet.Rollback();  // leaves nothing to undo
  EXPECT_EQ(fleet.Undo("ann", now - begin, now).undone, 0);
}

TEST(FleetHeadTest, ContributionsAreKeptUpToABound) {
  FleetHead fleet(TestPolicy());
  const auto most = static_cast<int>(FleetHead::kMostKeptNumbers) / kSize;
  for (int i = 0; i <= most; ++i) {
    fleet.Merge({.operators = {"ann"}, .delta = DeltaOf(i)}, absl::Milliseconds(i + 1));
  }
  const absl::Duration now = absl::Milliseconds(most + 1);
  EXPECT_EQ(fleet.Undo("ann", absl::Milliseconds(most), now).undone, -1);
  EXPECT_EQ(fleet.Undo("ann", absl::Milliseconds(most - 1), now).undone, most);
  EXPECT_EQ(fleet.Read()->delta, DeltaOf(0));
}

// A protected head and what its contributors do, with names that tell them apart.
class ProtectedHead {
 public:
  MergeOutcome Merge(const std::string& contributor, double length, double episode_return,
                     bool held_out = false) {
    Contribution contribution = {.contributor = contributor,
                                 .held_out = held_out,
                                 .delta = Eigen::VectorXf::Zero(kSize),
                                 .episode_return = episode_return};
    contribution.delta[0] = static_cast<float>(length);
    now_ += absl::Seconds(1);
    return head_.Merge(contribution, now_, ContributionBudget::kProtectedMembers);
  }

  // Ends `episodes` episodes of five contributors in turn. Returns true if the head was rolled
  // back.
  bool Play(size_t episodes, double length, double episode_return) {
    bool rolled_back = false;
    for (size_t i = 0; i < episodes; ++i) {
      rolled_back |= Merge(std::to_string(i % 5), length, episode_return).rolled_back;
    }
    return rolled_back;
  }

  FleetHead& head() { return head_; }
  double moved() const { return head_.Read()->delta[0]; }

 private:
  FleetHead head_ = FleetHead(TestPolicy());
  absl::Duration now_;
};

constexpr double kLength = 0.01;

TEST(FleetHeadTest, ALongContributionIsShortenedToThoseOfTheOthers) {
  ProtectedHead fleet;
  fleet.Play(ReturnGuard::kWindow, kLength, 10.0);
  const double before = fleet.moved();
  EXPECT_EQ(fleet.Merge("attacker", 0.4, 10.0).update, UpdateOutcome::kApplied);
  EXPECT_NEAR(fleet.moved() - before, PeerNorms::kFactor * kLength, 1e-6);
  EXPECT_EQ(fleet.head().Read()->trimmed, 1);
}

TEST(FleetHeadTest, WhatWasGatheredBeforeTheReferenceIsShortened) {
  ProtectedHead fleet;
  for (int i = 0; i < ContributionBudget::kPerWindow; ++i) fleet.Merge("attacker", 0.4, 10.0);
  fleet.Play(ReturnGuard::kWindow - ContributionBudget::kPerWindow - 1, kLength, 10.0);
  EXPECT_EQ(fleet.moved(), 0.0);
  fleet.Merge("4", kLength, 10.0);
  const double attacks = ContributionBudget::kPerWindow * PeerNorms::kFactor * kLength;
  const double others = (ReturnGuard::kWindow - ContributionBudget::kPerWindow) * kLength;
  EXPECT_NEAR(fleet.moved(), attacks + others, 1e-6);
  EXPECT_EQ(fleet.head().Read()->trimmed, ContributionBudget::kPerWindow);
}

TEST(FleetHeadTest, AHeldOutSessionContributesOnlyToAHeadThatIsNotProtected) {
  ProtectedHead fleet;
  fleet.Play(ReturnGuard::kWindow, kLength, 10.0);
  const double before = fleet.moved();
  EXPECT_EQ(fleet.Merge("judge", kLength, 10.0, /*held_out=*/true).update, UpdateOutcome::kHeldOut);
  EXPECT_EQ(fleet.moved(), before);
  EXPECT_EQ(fleet.head().Read()->rejected, 1);
  FleetHead small(TestPolicy());
  const auto merged = small.Merge({.contributor = "a", .held_out = true, .delta = DeltaOf(1)},
                                  absl::ZeroDuration());
  EXPECT_EQ(merged.update, UpdateOutcome::kApplied);
}

// Contributors that invent good returns hide from the first guard that the head becomes worse.
TEST(FleetHeadTest, ReturnsOfHeldOutSessionsCannotBeInventedByThoseWhoContribute) {
  ProtectedHead fleet;
  const auto judges = [&](double episode_return) {
    bool rolled_back = false;
    for (size_t i = 0; i < ReturnGuard::kWindow; ++i) {
      const std::string judge = "judge" + std::to_string(i % 5);
      // Five contributors end most of the episodes of every window of the first guard.
      rolled_back |= fleet.Play(4, kLength, 10.0);
      rolled_back |= fleet.Merge(judge, kLength, episode_return, /*held_out=*/true).rolled_back;
    }
    return rolled_back;
  };
  EXPECT_FALSE(judges(10.0));
  EXPECT_GT(fleet.moved(), 0.0);
  EXPECT_TRUE(judges(1.0));
  EXPECT_EQ(fleet.head().Read()->rollbacks, 1);
}

TEST(FleetHeadTest, AFleetWhoseSessionsAreAllSuspendedGoesOn) {
  ProtectedHead fleet;
  EXPECT_FALSE(fleet.Play(ReturnGuard::kWindow, kLength, 10.0));
  EXPECT_TRUE(fleet.Play(ReturnGuard::kWindow, kLength, 1.0));
  EXPECT_EQ(fleet.Merge("0", kLength, 10.0).update, UpdateOutcome::kOverBudget);
  fleet.Play(ReturnGuard::kWindow * ContributionBudget::kSuspendedWindows, kLength, 10.0);
  EXPECT_EQ(fleet.Merge("0", kLength, 10.0).update, UpdateOutcome::kApplied);
}

TEST(FleetHeadTest, AboutOneSessionInFiveIsHeldOut) {
  constexpr int kSessions = 10000;
  int held_out = 0;
  int both = 0;  // with another key, too
  for (int i = 0; i < kSessions; ++i) {
    const std::string id = "session" + std::to_string(i);
    held_out += IsHeldOut({1, 2}, id) ? 1 : 0;
    both += IsHeldOut({1, 2}, id) && IsHeldOut({1, 3}, id) ? 1 : 0;
  }
  constexpr int kShare = static_cast<int>(kHeldOutShare);
  EXPECT_NEAR(held_out, kSessions / kShare, 200);
  EXPECT_NEAR(both, kSessions / kShare / kShare, 100);
}

TEST(FleetHeadTest, OpenSessionsThatAreHeldOutAreCounted) {
  const auto head = std::make_shared<FleetHead>(TestPolicy());
  std::vector<std::unique_ptr<FleetHead::Member>> members;
  int64_t held_out = 0;
  for (size_t i = 0; i < 40; ++i) {
    const std::string id = std::to_string(i);
    members.push_back(std::make_unique<FleetHead::Member>(head, id, id));
    held_out += members.back()->held_out() ? 1 : 0;
    const bool is_protected = members.size() >= ContributionBudget::kProtectedMembers;
    EXPECT_EQ(head->HeldOutSessions(), is_protected ? held_out : 0);
  }
  members.resize(ContributionBudget::kProtectedMembers - 1);
  EXPECT_EQ(head->HeldOutSessions(), 0);
}

}  // namespace
}  // namespace spikeserve
