#include "core/open_sessions/session_store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>
#include <set>
#include <thread>
#include <vector>

#include "core/open_sessions/session_locks.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

class SessionStoreTest : public ::testing::Test {
 protected:
  std::string MustOpen(SessionStore& store) {
    auto id = store.Open(served_, SmallOptions());
    EXPECT_TRUE(id.ok()) << id.status();
    return id.value_or("");
  }

  FakeClock clock_;
  std::shared_ptr<RecordingObserver> observer_ = std::make_shared<RecordingObserver>();
  std::shared_ptr<const ServedPolicy> served_ =
      Serve(SmallConfig(), ActionSpace::Discrete(2), observer_);
};

TEST_F(SessionStoreTest, IdsAreRandomAndFindTheirSession) {
  SessionStore store(1000, &clock_);
  std::set<std::string> ids;
  for (int i = 0; i < 200; ++i) ids.insert(MustOpen(store));
  EXPECT_EQ(ids.size(), 200u);
  EXPECT_EQ(store.size(), 200);
  for (const std::string& id : ids) {
    EXPECT_THAT(id, ::testing::MatchesRegex("[0-9a-f]{32}"));
    const auto entry = store.Find(id);
    ASSERT_TRUE(entry.ok()) << entry.status();
    absl::MutexLock lock(&(*entry)->mutex);
    EXPECT_EQ((*entry)->agent.session().id, id);
    EXPECT_EQ((*entry)->agent.session().return_to_go, 10.0);
  }
}

TEST_F(SessionStoreTest, OnlyIdleSessionsAreRemoved) {
  SessionStore store(10, &clock_);
  const std::string idle = MustOpen(store);
  const std::string used = MustOpen(store);
  const std::string held = MustOpen(store);
  const auto holder = store.Find(held);
  clock_.Advance(absl::Seconds(6));
  ASSERT_TRUE(store.Find(used).ok());
  EXPECT_EQ(store.RemoveIdle(absl::Seconds(10)), 0);
  clock_.Advance(absl::Seconds(6));
  EXPECT_EQ(store.RemoveIdle(absl::Seconds(10)), 1);
  EXPECT_FALSE(store.Find(idle).ok());
  EXPECT_TRUE(store.Find(used).ok());
  EXPECT_TRUE(store.Find(held).ok());
  EXPECT_EQ(store.size(), 2);
  EXPECT_EQ(observer_->closed, 1);
}

TEST_F(SessionStoreTest, PeekingIsNoUse) {
  SessionStore store(10, &clock_);
  const std::string id = MustOpen(store);
  clock_.Advance(absl::Seconds(11));
  EXPECT_NE(store.Peek(id), nullptr);
  EXPECT_EQ(store.Peek("nobody's"), nullptr);
  EXPECT_EQ(store.RemoveIdle(absl::Seconds(10)), 1);
  EXPECT_EQ(store.Peek(id), nullptr);
}

TEST_F(SessionStoreTest, IdleSessionsAreCompactedOnceUntilTheyAreUsed) {
  SessionStore store(10, &clock_);
  const std::string id = MustOpen(store);
  const std::string held = MustOpen(store);
  const auto holder = store.Find(held);
  clock_.Advance(absl::Seconds(6));
  EXPECT_EQ(store.CompactIdle(absl::Seconds(10)), 0);
  clock_.Advance(absl::Seconds(6));
  EXPECT_EQ(store.CompactIdle(absl::Seconds(10)), 1);
  EXPECT_EQ(store.CompactIdle(absl::Seconds(10)), 0);
  ASSERT_TRUE(store.Find(id).ok());
  clock_.Advance(absl::Seconds(12));
  EXPECT_EQ(store.CompactIdle(absl::Seconds(10)), 1);
}

// Wraps an engine and counts the contexts it creates.
class CountingEngine final : public Engine {
 public:
  explicit CountingEngine(std::shared_ptr<const Engine> engine) : engine_(std::move(engine)) {}

  const Policy& policy() const override { return engine_->policy(); }
  std::unique_ptr<Context> NewContext(int64_t first_timestep) const override {
    ++contexts;
    return engine_->NewContext(first_timestep);
  }
  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override {
    engine_->Decide(context, return_to_go, observation, output);
  }
  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override {
    engine_->AppendAction(context, encoded_action);
  }

  mutable int contexts = 0;

 private:
  std::shared_ptr<const Engine> engine_;
};

TEST_F(SessionStoreTest, ACompactedSessionGoesOnBitForBit) {
  auto counting = std::make_shared<ServedPolicy>(*served_);
  const auto engine = std::make_shared<CountingEngine>(served_->engine);
  counting->engine = engine;
  SessionStore store(10, &clock_);
  const auto steady = store.Open(served_, SmallOptions());
  const auto idling = store.Open(counting, SmallOptions());
  const auto act = [&](const std::string& id, int64_t t) {
    const auto entry = store.Find(id);
    absl::MutexLock lock(&(*entry)->mutex);
    return **(*entry)->agent.Act(t, ObservationAt(t), RewardAt(t));
  };
  for (int64_t t = 0; t < 30; ++t) {
    const Answer expected = act(*steady, t);
    if (t % 4 == 3) {
      clock_.Advance(absl::Seconds(10));
      const auto hold = store.Find(*steady);
      EXPECT_EQ(store.CompactIdle(absl::Seconds(10)), 1);
    }
    Answer actual = act(*idling, t);
    actual.compute_seconds = expected.compute_seconds;
    EXPECT_EQ(actual, expected) << t;
  }
  EXPECT_EQ(engine->contexts, 8);  // the first one and 7 rebuilt ones
}

TEST_F(SessionStoreTest, AClosedSessionOutlivesTheStoreForItsHolder) {
  SessionStore store(10, &clock_);
  const std::string id = MustOpen(store);
  const auto entry = store.Find(id);
  ASSERT_TRUE(store.Close(id).ok());
  absl::MutexLock lock(&(*entry)->mutex);
  EXPECT_TRUE((*entry)->agent.Act(0, ObservationAt(0), 0.0).ok());
}

TEST_F(SessionStoreTest, ManyThreadsShareIt) {
  const auto served = Serve(SmallConfig(), ActionSpace::Discrete(2));
  SessionStore store(1000, &clock_);
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&] {
      for (int j = 0; j < 50; ++j) {
        const auto id = store.Open(served, SmallOptions());
        const auto entry = store.Find(*id);
        {
          absl::MutexLock lock(&(*entry)->mutex);
          EXPECT_TRUE((*entry)->agent.Act(0, ObservationAt(j), 0.0).ok());
        }
        store.RemoveIdle(absl::Hours(1));
        EXPECT_TRUE(store.Close(*id).ok());
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(store.size(), 0);
}

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

}  // namespace
}  // namespace spikeserve
