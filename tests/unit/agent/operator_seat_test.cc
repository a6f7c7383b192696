// Who chooses a session's action: a hold, an operator, or the policy.
#include "core/agent/operator_seat.h"

#include <gtest/gtest.h>

#include <memory>

#include "absl/time/time.h"
#include "core/agent/agent_session.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

class OperatorSeatTest : public ::testing::Test {
 protected:
  AgentSession NewAgent(std::optional<LearningOptions> learning = std::nullopt) {
    SessionOptions options = SmallOptions();
    options.learning = learning;
    return AgentSession(served_, NewSession("id", std::move(options)), &clock_);
  }

  // Decides the next step. Returns who chose the action.
  SourceKind Act(AgentSession& agent) {
    const int64_t t = agent.session().step;
    const auto answer = agent.Act(t, ObservationAt(t), RewardAt(t));
    EXPECT_TRUE(answer.ok()) << answer.status();
    return (*answer)->source.kind;
  }

  static Seat SeatOf(const char* lease_id, int action, double seconds = 1.0) {
    return {.operator_id = lease_id,
            .lease_id = lease_id,
            .lease_seconds = seconds,
            .action = {.discrete = action, .continuous = {}}};
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(SmallConfig(), ActionSpace::Discrete(3));
};

TEST_F(OperatorSeatTest, OneOperatorIsHeardUntilTheLeaseEnds) {
  AgentSession agent = NewAgent();
  EXPECT_EQ(Act(agent), SourceKind::kPolicy);
  ASSERT_TRUE(agent.TakeControl(SeatOf("ann", 2), false).ok());
  EXPECT_TRUE(absl::IsFailedPrecondition(agent.TakeControl(SeatOf("bob", 1), false)));
  EXPECT_EQ(Act(agent), SourceKind::kOperator);
  EXPECT_EQ(agent.session().last_answer->action.discrete, 2);
  EXPECT_EQ(agent.session().history.action(1).discrete, 2);

  ASSERT_TRUE(agent.TakeControl(SeatOf("bob", 1), true).ok());
  EXPECT_TRUE(absl::IsFailedPrecondition(agent.Steer("ann", nullptr)));
  clock_.Advance(absl::Milliseconds(900));
  ASSERT_TRUE(agent.Steer("bob", nullptr).ok());
  clock_.Advance(absl::Milliseconds(900));
  EXPECT_EQ(Act(agent), SourceKind::kOperator);
  EXPECT_EQ(agent.session().last_answer->source.operator_id, "bob");
  clock_.Advance(absl::Milliseconds(100));
  EXPECT_EQ(Act(agent), SourceKind::kPolicy);
  EXPECT_TRUE(absl::IsFailedPrecondition(agent.Steer("bob", nullptr)));
}

TEST_F(OperatorSeatTest, ALeaseGoesOnWhereItWasAndNoLonger) {
  AgentSession agent = NewAgent();
  ASSERT_TRUE(agent.TakeControl(SeatOf("ann", 2), false).ok());
  clock_.Advance(absl::Milliseconds(700));
  EXPECT_EQ(Act(agent), SourceKind::kOperator);
  auto stored = ParseSession(SerializeSession(agent.session()));
  ASSERT_TRUE(stored.ok()) << stored.status();
  clock_.Advance(absl::Hours(1));  // in which no server has the session
  AgentSession next(served_, *std::move(stored), &clock_);
  clock_.Advance(absl::Milliseconds(250));
  EXPECT_EQ(Act(next), SourceKind::kOperator);
  EXPECT_EQ(next.session().seat->steps, 2);
  clock_.Advance(absl::Milliseconds(50));
  EXPECT_EQ(Act(next), SourceKind::kPolicy);
}

TEST_F(OperatorSeatTest, AHoldIsStrongerAndTeachesNothing) {
  AgentSession agent =
      NewAgent(LearningOptions{.modulator = Modulator::kTarget, .learning_rate = 0.1});
  Act(agent);
  const Eigen::VectorXf before = agent.HeadDelta();
  ASSERT_TRUE(agent.TakeControl(SeatOf("ann", 2), false).ok());
  agent.SetHold(std::make_shared<const Hold>(Hold{"h", "smoke"}));
  EXPECT_EQ(Act(agent), SourceKind::kHold);
  EXPECT_EQ(agent.session().last_answer->action.discrete, 0);
  EXPECT_FALSE(agent.is_at_neutral());
  EXPECT_EQ(Act(agent), SourceKind::kHold);
  EXPECT_TRUE(agent.is_at_neutral());
  EXPECT_EQ(agent.HeadDelta(), before);
  agent.SetHold(nullptr);
  EXPECT_EQ(Act(agent), SourceKind::kOperator);
  EXPECT_FALSE(agent.is_at_neutral());
}

TEST_F(OperatorSeatTest, AnotherActionDoesNotConfirmTheHold) {
  AgentSession agent = NewAgent();
  agent.SetHold(std::make_shared<const Hold>(Hold{"h", ""}));
  Act(agent);
  const int64_t t = agent.session().step;
  ASSERT_TRUE(agent.Act(t, ObservationAt(t), RewardAt(t), ReportedAction(int64_t{1})).ok());
  EXPECT_FALSE(agent.is_at_neutral());
}

TEST(AgreeTest, ATenthOfTheRangeOfABox) {
  const ActionSpace box = ActionSpace::Box({-1.0f, 0.0f}, {1.0f, 10.0f});
  const Action a = {0, {0.0f, 5.0f}};
  EXPECT_TRUE(Agree(box, a, {0, {0.2f, 6.0f}}));
  EXPECT_FALSE(Agree(box, a, {0, {0.25f, 5.0f}}));
  EXPECT_FALSE(Agree(ActionSpace::Discrete(2), {1, {}}, {0, {}}));
}

}  // namespace
}  // namespace spikeserve
