#include "core/agent/shadow_session.h"

#include <gtest/gtest.h>

#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

class ShadowSessionTest : public ::testing::Test {
 protected:
  // Makes the next decision of the served session and returns it as input for the shadow.
  ShadowStep Serve(AgentSession& agent) {
    const int64_t step = agent.session().step;
    const auto answer = agent.Act(step, ObservationAt(step), 0.5);
    EXPECT_TRUE(answer.ok()) << answer.status();
    return {.episode = agent.session().episode,
            .step = step,
            .observation = ObservationAt(step),
            .reward = 0.5,
            .target_return = agent.session().target_return,
            .served = **answer};
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> policy_ =
      spikeserve::Serve(SmallConfig(), ActionSpace::Discrete(3));
  AgentSession agent_{policy_, NewSession("served", SmallOptions()), &clock_};
  ShadowSession shadow_{*policy_, SmallOptions(), &clock_};
};

TEST_F(ShadowSessionTest, ItsWindowHoldsTheActionsThatWereExecuted) {
  for (int step = 0; step < 20; ++step) {
    std::optional<ReportedAction> executed;
    ShadowStep seen;
    if (step > 0) {
      seen.executed = Action{.discrete = step % 3, .continuous = {}};
      executed = int64_t{step % 3};
    }
    const auto served = agent_.Act(step, ObservationAt(step), 0.5, executed);
    ASSERT_TRUE(served.ok()) << served.status();
    seen.step = step;
    seen.observation = ObservationAt(step);
    seen.reward = 0.5;
    seen.target_return = agent_.session().target_return;
    seen.served = **served;
    const auto answer = shadow_.Act(seen);
    ASSERT_TRUE(answer.ok()) << answer.status();
    EXPECT_EQ((*answer)->counts, (*served)->counts) << step;
  }
}

TEST_F(ShadowSessionTest, AnEpisodeWithAHoleIsLostUntilTheNext) {
  ASSERT_TRUE(shadow_.Act(Serve(agent_)).ok());
  Serve(agent_);  // the shadow misses this step
  EXPECT_EQ(shadow_.Act(Serve(agent_)).status().code(), absl::StatusCode::kFailedPrecondition);
  ASSERT_TRUE(agent_.EndEpisode({}).ok());
  Serve(agent_);  // the shadow misses the first step of the second episode
  EXPECT_EQ(shadow_.Act(Serve(agent_)).status().code(), absl::StatusCode::kFailedPrecondition);
  ASSERT_TRUE(agent_.EndEpisode({}).ok());
  EXPECT_TRUE(shadow_.Act(Serve(agent_)).ok());
}

}  // namespace
}  // namespace spikeserve
