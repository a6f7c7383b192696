#include "server/heads/head_replica.h"

#include <gtest/gtest.h>

#include <cmath>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"

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

HeadReplica NewReplica() { return HeadReplica(std::make_shared<TenantHeads>(TestPolicy())); }

// Returns what episode `i` of seven sessions of two tenants contributes.
HeadEntry Contribution(int i) {
  HeadEntry entry;
  entry.session = absl::StrCat("session", i % 7);
  entry.episode = i / 7;
  entry.head = std::string(i % 3 == 0 ? 1 : 0, 'a');
  entry.contributor = entry.session;
  entry.held_out = i % 7 == 2;
  entry.delta.resize(kSize);
  for (Eigen::Index j = 0; j < kSize; ++j) {
    entry.delta[j] = 0.03f * std::sin(0.7f * static_cast<float>(i) + static_cast<float>(j));
  }
  entry.episode_return = i < 100 ? 10.0 : 1.0;
  return entry;
}

// A log as Redis keeps it.
class Log {
 public:
  void Append(const HeadEntry& entry, int64_t members = 1) {
    LoggedEntry logged;
    logged.position.number = static_cast<int64_t>(entries_.size()) + 1;
    logged.position.id = absl::StrCat(1'000'000 + 500 * logged.position.number, "-0");
    logged.members = members;
    logged.bytes = SerializeHeadEntry(entry);
    logged.position.digest =
        NextDigest(entries_.empty() ? "" : entries_.back().position.digest, logged);
    entries_.push_back(std::move(logged));
  }
  const LoggedEntry& entry(int64_t number) const {
    return entries_[static_cast<size_t>(number - 1)];
  }
  int64_t size() const { return static_cast<int64_t>(entries_.size()); }

  void FoldInto(HeadReplica& replica, int64_t last) const {
    for (int64_t n = replica.position().number + 1; n <= last; ++n) {
      ASSERT_TRUE(replica.Fold(entry(n)).ok()) << n;
    }
  }

 private:
  std::vector<LoggedEntry> entries_;
};

// Contributions with rollbacks by the guard, an operator's rollback, a pause and its end.
Log FullLog() {
  Log log;
  for (int i = 0; i < 150; ++i) {
    log.Append(Contribution(i), i < 50 ? 2 : 7);
    HeadEntry action;
    action.session = absl::StrCat("action", i);
    if (i == 30) action.kind = HeadEntry::Kind::kRollback;
    if (i == 60) action.kind = HeadEntry::Kind::kPause;
    if (i == 64) action.kind = HeadEntry::Kind::kResume;
    if (action.kind != HeadEntry::Kind::kMerge) log.Append(action);
  }
  return log;
}

TEST(HeadReplicaTest, AReplicaThatJoinsAtAnyPlaceBecomesEqual) {
  const Log log = FullLog();
  HeadReplica first = NewReplica();
  for (int64_t joined = 0; joined <= log.size(); joined += 17) {
    log.FoldInto(first, joined);
    HeadReplica second = NewReplica();
    ASSERT_TRUE(second.Restore(first.position(), first.Serialize()).ok());
    HeadReplica whole = NewReplica();
    log.FoldInto(whole, log.size());
    log.FoldInto(second, log.size());
    EXPECT_EQ(second.Serialize(), whole.Serialize());
    EXPECT_EQ(second.position(), whole.position());
  }
  EXPECT_GT(first.heads()->Of("")->Read()->rollbacks, 1);  // one by the guard
}

TEST(HeadReplicaTest, WhatDoesNotFollowChangesNothing) {
  const Log log = FullLog();
  HeadReplica replica = NewReplica();
  log.FoldInto(replica, 10);
  const std::string before = replica.Serialize();
  EXPECT_TRUE(absl::IsDataLoss(replica.Fold(log.entry(12)).status()));  // a gap
  EXPECT_TRUE(absl::IsDataLoss(replica.Fold(log.entry(10)).status()));  // a repetition
  LoggedEntry changed = log.entry(11);
  changed.members = 9;
  EXPECT_TRUE(absl::IsDataLoss(replica.Fold(changed).status()));
  LoggedEntry unknown = log.entry(11);
  unknown.bytes = std::string("of a later release");
  unknown.position.digest = NextDigest(replica.position().digest, unknown);
  EXPECT_TRUE(absl::IsInvalidArgument(replica.Fold(unknown).status()));
  EXPECT_EQ(replica.Serialize(), before);
  EXPECT_TRUE(replica.Fold(log.entry(11)).ok());
}

TEST(HeadReplicaTest, OutcomesAreRemembered) {
  const Log log = FullLog();
  HeadReplica replica = NewReplica();
  log.FoldInto(replica, log.size());
  const auto paused = replica.Find("session5", 8);  // contribution 61
  ASSERT_TRUE(paused.has_value());
  EXPECT_TRUE(paused->paused);
  EXPECT_FALSE(replica.Find("session5", 7)->paused);
  EXPECT_FALSE(replica.Find("session5", 700).has_value());
  EXPECT_TRUE(replica.HasPassed(log.entry(20).position));
  HeadPosition other = log.entry(20).position;
  other.digest += "0";
  EXPECT_FALSE(replica.HasPassed(other));
}

TEST(HeadReplicaTest, TakesOverAnOlderState) {
  const Log log = FullLog();
  HeadReplica ahead = NewReplica(), behind = NewReplica();
  log.FoldInto(ahead, 90);
  log.FoldInto(behind, 1);
  ahead.TakeOver(behind);
  EXPECT_EQ(ahead.position(), behind.position());
  log.FoldInto(ahead, 90);
  log.FoldInto(behind, 90);
  EXPECT_EQ(ahead.Serialize(), behind.Serialize());
}

TEST(HeadReplicaTest, HeadsOfAnotherPolicyAreRefused) {
  const Log log = FullLog();
  HeadReplica replica = NewReplica();
  log.FoldInto(replica, 3);
  Policy larger = *TestPolicy();
  larger.weights.head.weight = {.shape = {2, 4}, .values = std::vector<float>(8, 1.0f)};
  HeadReplica other(
      std::make_shared<TenantHeads>(std::make_shared<const Policy>(std::move(larger))));
  const auto refused = other.Restore(replica.position(), replica.Serialize());
  EXPECT_TRUE(absl::IsInvalidArgument(refused)) << refused;
  EXPECT_EQ(other.position(), HeadPosition());
}

}  // namespace
}  // namespace spikeserve
