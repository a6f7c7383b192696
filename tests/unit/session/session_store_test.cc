#include "core/session/session_store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <set>
#include <thread>

#include "core/session/session_reaper.h"
#include "tests/unit/session/fake_clock.h"
#include "tests/unit/session/session_fixture.h"

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
  SessionReaper reaper(&store, absl::Milliseconds(1), [&](int64_t count) {
    EXPECT_EQ(count, 1);
    reaped.Notify();
  });
  reaped.WaitForNotification();
  EXPECT_EQ(store.size(), 0);
}

}  // namespace
}  // namespace spikeserve
