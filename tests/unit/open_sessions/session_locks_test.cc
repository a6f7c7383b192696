#include "core/open_sessions/session_locks.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <memory>
#include <thread>
#include <vector>

#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

class SessionLocksTest : public testing::Test {
 protected:
  SessionLocksTest() {
    const auto served = Serve(SmallConfig(), ActionSpace::Discrete(2));
    for (int i = 0; i < 8; ++i) {
      entries_.push_back(
          std::make_shared<SessionEntry>(served, NewSession("id", SmallOptions()), &clock_));
    }
  }

  // Returns whether another thread can lock the entry.
  static bool IsFree(SessionEntry& entry) {
    bool free = false;
    std::thread([&]() ABSL_NO_THREAD_SAFETY_ANALYSIS {
      free = entry.mutex.TryLock();
      if (free) entry.mutex.Unlock();
    }).join();
    return free;
  }

  FakeClock clock_;
  std::vector<std::shared_ptr<SessionEntry>> entries_;
};

TEST_F(SessionLocksTest, HoldsEveryLockUntilItEnds) {
  {
    const SessionLocks locks(entries_);
    for (const auto& entry : entries_) EXPECT_FALSE(IsFree(*entry));
  }
  for (const auto& entry : entries_) EXPECT_TRUE(IsFree(*entry));
}

TEST_F(SessionLocksTest, AnEntryMayStandThereTwice) {
  std::vector<std::shared_ptr<SessionEntry>> twice = {entries_[0], entries_[1], entries_[0]};
  { const SessionLocks locks(twice); }
  EXPECT_TRUE(IsFree(*entries_[0]));
}

TEST_F(SessionLocksTest, KeepsItsSessionsAlive) {
  const std::weak_ptr<SessionEntry> weak = entries_.back();
  {
    const SessionLocks locks(entries_);
    entries_.clear();
    EXPECT_FALSE(weak.expired());
  }
  EXPECT_TRUE(weak.expired());
}

// Two threads lock the same sessions, each in the reverse order of the other. They would deadlock
// if the locks were taken in the order of the entries.
TEST_F(SessionLocksTest, OppositeOrdersNeverWaitForEachOther) {
  std::vector<std::shared_ptr<SessionEntry>> reversed = entries_;
  std::reverse(reversed.begin(), reversed.end());
  int64_t inside = 0;  // guarded by the locks of all sessions
  const auto lock_often = [&inside](const auto& entries) {
    for (int i = 0; i < 20'000; ++i) {
      const SessionLocks locks(entries);
      ++inside;
    }
  };
  std::thread forward([&] { lock_often(entries_); });
  std::thread backward([&] { lock_often(reversed); });
  forward.join();
  backward.join();
  EXPECT_EQ(inside, 40'000);
}

}  // namespace
}  // namespace spikeserve
