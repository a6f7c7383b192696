// Tests of sessions that share a head: the behaviour that the session adds to FleetHead, which has
// its own tests.
#include <gtest/gtest.h>

#include <atomic>
#include <thread>
#include <vector>

#include "absl/synchronization/notification.h"
#include "absl/time/time.h"
#include "core/agent/agent_session.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

class FleetSessionTest : public ::testing::Test {
 protected:
  AgentSession NewAgent(uint64_t seed) {
    SessionOptions options = SmallOptions();
    options.seed = seed;
    options.action_selection = {.sample = true, .temperature = 0.7f};
    options.learning = LearningOptions{.scope = Scope::kFleet, .learning_rate = 0.001};
    return AgentSession(served_, NewSession("id", std::move(options)), &clock_);
  }

  void Play(AgentSession& agent) {
    for (int64_t t = 0; t < 10; ++t) {
      ASSERT_TRUE(agent.Act(t, ObservationAt(t), RewardAt(t)).ok());
    }
  }

  void End(AgentSession& agent) {
    ASSERT_TRUE(agent.EndEpisode({.reward = 2.0, .terminated = true, .target_return = {}}).ok());
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(SmallConfig(), ActionSpace::Discrete(3));
};

// A test for the thread sanitizer: sessions on 64 threads play whole episodes while an operator
// reads, pauses and rolls back.
TEST_F(FleetSessionTest, SixtyFourLearnAtOnce) {
  constexpr int kSessions = 64, kEpisodes = 3;
  std::vector<std::thread> threads;
  for (uint64_t seed = 0; seed < kSessions; ++seed) {
    threads.emplace_back([this, seed] {
      AgentSession agent = NewAgent(seed);
      for (int episode = 0; episode < kEpisodes; ++episode) {
        Play(agent);
        End(agent);
      }
    });
  }
  served_->learning->set_paused(true);
  const auto standing = served_->HeadOf("")->Read();
  EXPECT_EQ(served_->HeadOf("")->Read(), standing);
  served_->learning->set_paused(false);
  served_->HeadOf("")->Rollback();
  for (std::thread& thread : threads) thread.join();
  EXPECT_LE(served_->HeadOf("")->Read()->updates, kSessions * kEpisodes);
  EXPECT_LE(served_->HeadOf("")->Read()->drift, FleetOptions().max_drift + 1e-6);
}

TEST(LearningSwitchTest, APauseWaitsForTheMergeUnderWayAndLetsNoneFollow) {
  LearningSwitch learning;
  absl::Notification merging, paused;
  std::atomic<bool> merged = false;
  std::thread session([&] {
    EXPECT_TRUE(learning.MergeUnlessPaused([&] {
      merging.Notify();
      EXPECT_FALSE(paused.WaitForNotificationWithTimeout(absl::Milliseconds(50)));
      merged = true;
    }));
  });
  merging.WaitForNotification();
  learning.set_paused(true);
  EXPECT_TRUE(merged);
  paused.Notify();
  session.join();
  EXPECT_FALSE(learning.MergeUnlessPaused([] { ADD_FAILURE() << "called"; }));
  learning.set_paused(false);
  EXPECT_TRUE(learning.MergeUnlessPaused([] {}));
}

}  // namespace
}  // namespace spikeserve
