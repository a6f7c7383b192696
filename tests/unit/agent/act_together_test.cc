#include <gtest/gtest.h>

#include <memory>
#include <vector>

#include "core/agent/agent_session.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

class ActTogetherTest : public ::testing::Test {
 protected:
  static SessionOptions Options(int i) {
    SessionOptions options = SmallOptions();
    options.seed = static_cast<uint64_t>(i);
    options.action_selection.sample = i % 2 == 1;
    options.target_return += i;
    if (i % 3 == 2) options.learning.emplace();
    return options;
  }

  // Returns sessions that alternate between two versions; some sample and some learn.
  std::vector<std::unique_ptr<AgentSession>> NewSessions() {
    std::vector<std::unique_ptr<AgentSession>> sessions;
    for (int i = 0; i < 8; ++i) {
      sessions.push_back(std::make_unique<AgentSession>(i % 2 == 0 ? even_ : odd_,
                                                        NewSession("id", Options(i)), &clock_));
    }
    return sessions;
  }

  static void Apply(std::vector<Step>& steps) {
    std::vector<Step*> all;
    for (Step& step : steps) all.push_back(&step);
    AgentSession::Apply(all);
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> even_ = Serve(SmallConfig(), ActionSpace::Discrete(2));
  std::shared_ptr<const ServedPolicy> odd_ = Serve(SmallConfig(), ActionSpace::Discrete(3));
};

TEST_F(ActTogetherTest, EqualsOneAfterTheOtherBitForBit) {
  const auto alone = NewSessions();
  const auto together = NewSessions();
  for (int64_t step = 0; step < 30; ++step) {
    std::vector<std::vector<float>> observations;
    for (size_t i = 0; i < together.size(); ++i) {
      observations.push_back(ObservationAt(step + static_cast<int64_t>(i)));
    }
    std::vector<Step> steps;
    std::vector<AgentSession*> sessions;
    for (size_t i = 0; i < together.size(); ++i) {
      steps.push_back({.session = together[i].get(),
                       .place = {.step = step},
                       .observation = observations[i],
                       .reward = RewardAt(step)});
      sessions.push_back(together[i].get());
    }
    if (step % 7 == 3) together[2]->DropContext();
    Apply(steps);
    for (size_t i = 0; i < alone.size(); ++i) {
      ASSERT_TRUE(alone[i]->Act(step, observations[i], RewardAt(step)).ok());
      ASSERT_TRUE(steps[i].result.status.ok()) << steps[i].result.status;
      EXPECT_FALSE(steps[i].result.is_retry);
      EXPECT_EQ(SerializeSession(together[i]->session()), SerializeSession(alone[i]->session()))
          << "session " << i << " at step " << step;
    }
    if (step % 3 == 0) AgentSession::AppendPendingActions(sessions);
  }
}

}  // namespace
}  // namespace spikeserve
