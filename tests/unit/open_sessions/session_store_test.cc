#include "core/open_sessions/session_store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <set>
#include <thread>

#include "absl/synchronization/notification.h"
#include "core/open_sessions/session_reaper.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

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

TEST_F(SessionStoreTest, UnknownIdsAreNotFound) {
  SessionStore store(10, &clock_);
  const std::string id = MustOpen(store);
  EXPECT_TRUE(store.Close(id).ok());
  for (const auto& status : {store.Find(id).status(), store.Close(id), store.Find("").status()}) {
    EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
    EXPECT_THAT(std::string(status.message()), HasSubstr("session_id: expected an open session"));
  }
  EXPECT_EQ(store.size(), 0);
  EXPECT_EQ(observer_->opened, 1);
  EXPECT_EQ(observer_->closed, 1);
}

TEST_F(SessionStoreTest, LimitIsEnforcedAndNamed) {
  SessionStore store(2, &clock_);
  const std::string id = MustOpen(store);
  MustOpen(store);
  const auto refused = store.Open(served_, SmallOptions());
  EXPECT_EQ(refused.status().code(), absl::StatusCode::kResourceExhausted);
  EXPECT_THAT(std::string(refused.status().message()), HasSubstr("fewer than 2 open sessions"));
  ASSERT_TRUE(store.Close(id).ok());
  MustOpen(store);
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

TEST_F(SessionStoreTest, TheReaperTakesOutIdleSessions) {
  SessionStore store(10, &clock_);
  MustOpen(store);
  clock_.Advance(absl::Seconds(1));
  absl::Notification reaped;
  const IdleLimits limits = {.compact_after = absl::Milliseconds(1),
                             .time_to_live = absl::Milliseconds(1)};
  SessionReaper reaper(&store, limits, [&](int64_t count) {
    EXPECT_EQ(count, 1);
    reaped.Notify();
  });
  reaped.WaitForNotification();
  EXPECT_EQ(store.size(), 0);
}

}  // namespace
}  // namespace spikeserve
