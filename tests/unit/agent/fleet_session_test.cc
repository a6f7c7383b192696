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
  AgentSession NewAgent(uint64_t seed, bool learns = true) {
    SessionOptions options = SmallOptions();
    options.seed = seed;
    options.action_selection = {.sample = true, .temperature = 0.7f};
    if (learns) options.learning = LearningOptions{.scope = Scope::kFleet, .learning_rate = 0.001};
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

TEST_F(FleetSessionTest, WhatOneLearnsAllHave) {
  AgentSession teacher = NewAgent(1), pupil = NewAgent(2);
  Play(teacher);
  EXPECT_EQ(pupil.HeadDrift(), 0.0);  // updates are shared only at the end of an episode
  End(teacher);
  EXPECT_GT(pupil.HeadDrift(), 0.0);
  EXPECT_EQ(pupil.HeadDelta(), teacher.HeadDelta());
  EXPECT_EQ(pupil.HeadDelta(), served_->HeadOf("")->Read()->delta);
}

TEST_F(FleetSessionTest, EpisodesPlayedOnOneHeadLeaveTheSameHeadInAnyOrder) {
  const auto play = [&](bool reversed) {
    served_ = Serve(SmallConfig(), ActionSpace::Discrete(3));
    std::vector<AgentSession> agents;
    for (uint64_t seed = 0; seed < 16; ++seed) agents.push_back(NewAgent(seed));
    for (AgentSession& agent : agents) Play(agent);
    for (size_t i = 0; i < agents.size(); ++i) End(agents[reversed ? agents.size() - 1 - i : i]);
    return served_->HeadOf("")->Read()->delta;
  };
  const Eigen::VectorXf forwards = play(false), backwards = play(true);
  for (Eigen::Index i = 0; i < forwards.size(); ++i) {
    EXPECT_NEAR(forwards[i], backwards[i], FleetHead::kMergeTolerance);
  }
}

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

TEST_F(FleetSessionTest, AfterARollbackTheOldAnswersReturn) {
  const auto answers = [&] {
    AgentSession agent = NewAgent(3);
    std::vector<std::vector<float>> probabilities;
    for (int64_t t = 0; t < 10; ++t) {
      probabilities.push_back((*agent.Act(t, ObservationAt(t), RewardAt(t)))->probabilities);
    }
    return probabilities;
  };
  const auto before = answers();
  AgentSession teacher = NewAgent(1);
  Play(teacher);
  End(teacher);
  EXPECT_NE(answers(), before);
  served_->HeadOf("")->Rollback();
  EXPECT_EQ(answers(), before);
}

TEST_F(FleetSessionTest, FrozenSessionsOfThePolicyAreUntouched) {
  AgentSession alone = NewAgent(5, /*learns=*/false), frozen = NewAgent(5, /*learns=*/false);
  AgentSession teacher = NewAgent(1);
  for (int64_t t = 0; t < 10; ++t) {
    Play(teacher);
    End(teacher);
    EXPECT_EQ(**frozen.Act(t, ObservationAt(t), RewardAt(t)),
              **alone.Act(t, ObservationAt(t), RewardAt(t)));
  }
  EXPECT_GT(served_->HeadOf("")->Read()->drift, 0.0);
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
