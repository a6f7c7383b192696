#include "core/fleet/head_fold.h"

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

HeadFold NewFold() { return HeadFold(std::make_shared<TenantHeads>(TestPolicy())); }

// Returns what episode `i` of seven sessions of two tenants contributes.
HeadEntry EntryOf(int i) {
  Contribution contribution = {.session = absl::StrCat("session", i % 7),
                               .episode = i / 7,
                               .head = std::string(i % 3 == 0 ? 1 : 0, 'a'),
                               .held_out = i % 7 == 2,
                               .delta = Eigen::VectorXf(kSize),
                               .episode_return = i < 100 ? 10.0 : 1.0};
  contribution.contributor = contribution.session;
  if (i % 7 == 4) contribution.operators = {"ann", "operators: 3:bob,;"};
  for (Eigen::Index j = 0; j < kSize; ++j) {
    contribution.delta[j] = 0.03f * std::sin(0.7f * static_cast<float>(i) + static_cast<float>(j));
  }
  return {.contribution = std::move(contribution)};
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

  void FoldInto(HeadFold& fold, int64_t last) const {
    for (int64_t n = fold.position().number + 1; n <= last; ++n) {
      ASSERT_TRUE(fold.Fold(entry(n)).ok()) << n;
    }
  }

 private:
  std::vector<LoggedEntry> entries_;
};

// Contributions with rollbacks by the guard, an operator's rollback, a pause and its end, and
// corrections that are undone.
Log FullLog() {
  Log log;
  for (int i = 0; i < 150; ++i) {
    log.Append(EntryOf(i), i < 50 ? 2 : 7);
    HeadEntry action = {.contribution = {.session = absl::StrCat("action", i)}};
    if (i == 30) action.kind = HeadEntry::Kind::kRollback;
    if (i == 60) action.kind = HeadEntry::Kind::kPause;
    if (i == 64) action.kind = HeadEntry::Kind::kResume;
    if (i == 45 || i == 120) {
      action.kind = HeadEntry::Kind::kUndo;
      action.contribution.operators = {"ann"};
      action.contribution.episode_return = i == 45 ? 10.0 : 600.0;  // seconds
    }
    if (action.kind != HeadEntry::Kind::kMerge) log.Append(action);
  }
  return log;
}

TEST(HeadFoldTest, AFoldThatJoinsAtAnyPlaceBecomesEqual) {
  const Log log = FullLog();
  HeadFold first = NewFold();
  for (int64_t joined = 0; joined <= log.size(); joined += 17) {
    log.FoldInto(first, joined);
    HeadFold second = NewFold();
    ASSERT_TRUE(second.Restore(first.position(), first.Serialize()).ok());
    HeadFold whole = NewFold();
    log.FoldInto(whole, log.size());
    log.FoldInto(second, log.size());
    EXPECT_EQ(second.Serialize(), whole.Serialize());
    EXPECT_EQ(second.position(), whole.position());
  }
  EXPECT_GT(first.heads()->Of("")->Read()->rollbacks, 1);  // one by the guard
  EXPECT_EQ(first.Find("action45", 0)->undone, 1);
  EXPECT_GT(first.Find("action120", 0)->undone, 1);
}

TEST(HeadFoldTest, OperatorsOfAnEntryAreRead) {
  const HeadEntry entry = EntryOf(4);
  const auto parsed = ParseHeadEntry(SerializeHeadEntry(entry));
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  EXPECT_EQ(parsed->contribution.operators, entry.contribution.operators);
  EXPECT_EQ(parsed->contribution.contributor, "session4");
  for (const char* contributor : {"operators: ", "operators: 9:ann,;", "operators: 3:ann;"}) {
    HeadEntry damaged = entry;
    damaged.contribution.operators.clear();
    damaged.contribution.contributor = contributor;
    const auto refused = ParseHeadEntry(SerializeHeadEntry(damaged)).status();
    EXPECT_TRUE(absl::IsInvalidArgument(refused)) << contributor;
  }
}

TEST(HeadFoldTest, WhatDoesNotFollowChangesNothing) {
  const Log log = FullLog();
  HeadFold fold = NewFold();
  log.FoldInto(fold, 10);
  const std::string before = fold.Serialize();
  EXPECT_TRUE(absl::IsDataLoss(fold.Fold(log.entry(12))));  // a gap
  EXPECT_TRUE(absl::IsDataLoss(fold.Fold(log.entry(10))));  // a repetition
  LoggedEntry changed = log.entry(11);
  changed.members = 9;
  EXPECT_TRUE(absl::IsDataLoss(fold.Fold(changed)));
  LoggedEntry unknown = log.entry(11);
  unknown.bytes = std::string("of a later release");
  unknown.position.digest = NextDigest(fold.position().digest, unknown);
  EXPECT_TRUE(absl::IsInvalidArgument(fold.Fold(unknown)));
  EXPECT_EQ(fold.Serialize(), before);
  EXPECT_TRUE(fold.Fold(log.entry(11)).ok());
}

TEST(HeadFoldTest, OutcomesAreRemembered) {
  const Log log = FullLog();
  HeadFold fold = NewFold();
  log.FoldInto(fold, log.size());
  const auto paused = fold.Find("session5", 8);  // contribution 61
  ASSERT_TRUE(paused.has_value());
  EXPECT_TRUE(paused->paused);
  EXPECT_FALSE(fold.Find("session5", 7)->paused);
  EXPECT_FALSE(fold.Find("session5", 700).has_value());
  EXPECT_TRUE(fold.HasPassed(log.entry(20).position));
  HeadPosition other = log.entry(20).position;
  other.digest += "0";
  EXPECT_FALSE(fold.HasPassed(other));
}

TEST(HeadFoldTest, TakesOverAnOlderState) {
  const Log log = FullLog();
  HeadFold ahead = NewFold(), behind = NewFold();
  log.FoldInto(ahead, 90);
  log.FoldInto(behind, 1);
  ahead.TakeOver(behind);
  EXPECT_EQ(ahead.position(), behind.position());
  log.FoldInto(ahead, 90);
  log.FoldInto(behind, 90);
  EXPECT_EQ(ahead.Serialize(), behind.Serialize());
}

TEST(HeadFoldTest, HeadsOfAnotherPolicyAreRefused) {
  const Log log = FullLog();
  HeadFold fold = NewFold();
  log.FoldInto(fold, 3);
  Policy larger = *TestPolicy();
  larger.weights.head.weight = {.shape = {2, 4}, .values = std::vector<float>(8, 1.0f)};
  HeadFold other(std::make_shared<TenantHeads>(std::make_shared<const Policy>(std::move(larger))));
  const auto refused = other.Restore(fold.position(), fold.Serialize());
  EXPECT_TRUE(absl::IsInvalidArgument(refused)) << refused;
  EXPECT_EQ(other.position(), HeadPosition());
}

}  // namespace
}  // namespace spikeserve
