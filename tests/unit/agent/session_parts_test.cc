// Tests of the parts of a served session: the link to its robot, the summary of its life, its
// operators.
#include <gtest/gtest.h>

#include <cstdint>
#include <memory>

#include "absl/time/time.h"
#include "core/agent/agent_session.h"
#include "core/agent/operator_seat.h"
#include "core/agent/robot_link.h"
#include "core/agent/session_life.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

TEST(RobotLinkTest, AnObservationIsAsOldAsTheFastestRequestProves) {
  RobotLink link;
  const auto at = [](double seconds) { return absl::Seconds(seconds); };
  // The robot's clock is 1,000 s ahead; the fastest request takes an unknown time.
  link.OnRequest(at(5.0), at(1004.98));
  EXPECT_EQ(link.LeastAge(at(5.0), at(1004.98)), absl::ZeroDuration());
  link.OnRequest(at(5.02), at(1005.01));  // 10 ms faster
  EXPECT_EQ(link.LeastAge(at(5.02), at(1005.01)), absl::ZeroDuration());
  EXPECT_EQ(link.LeastAge(at(5.02), at(1004.98)), absl::Milliseconds(30));
  // Requests that waited in a cut link, and arrive together.
  link.OnRequest(at(25.0), at(1010.0));
  EXPECT_EQ(link.LeastAge(at(25.0), at(1010.0)), at(14.99));
  // A robot that has restarted.
  link.OnRequest(at(26.0), at(3.0));
  EXPECT_EQ(link.LeastAge(at(26.0), at(3.0)), absl::ZeroDuration());
}

// The robot's clock has stood still for 15 s while its computer was suspended.
TEST(RobotLinkTest, AClockThatStoodStillIsMeasuredAnew) {
  RobotLink link;
  const absl::Duration robot = absl::Seconds(1000);
  const auto late_at = [&](absl::Duration time, absl::Duration stood_still) {
    const absl::Duration observed_at = robot + time - stood_still;
    link.OnRequest(time, observed_at);
    return link.LeastAge(time, observed_at);
  };
  absl::Duration time;
  for (; time < absl::Seconds(3); time += absl::Milliseconds(20)) {
    EXPECT_EQ(late_at(time, absl::ZeroDuration()), absl::ZeroDuration());
  }
  const absl::Duration woken = time += absl::Seconds(15);
  for (; late_at(time, absl::Seconds(15)) > absl::Milliseconds(1); time += absl::Milliseconds(20)) {
    ASSERT_LT(time, woken + absl::Seconds(1));
  }
  EXPECT_GE(time, woken + RobotLink::kTrial);
}

// What waited in a link that was cut for 5 s arrives within half a second, which is slow.
TEST(RobotLinkTest, AQueueThatEmptiesIsNoClockThatStoodStill) {
  RobotLink link;
  link.OnRequest(absl::Seconds(10), absl::Seconds(1000));
  for (int i = 0; i < 250; ++i) {
    const absl::Duration observed_at = absl::Seconds(1000) + i * absl::Milliseconds(20);
    const absl::Duration received = absl::Seconds(15) + i * absl::Milliseconds(2);
    link.OnRequest(received, observed_at);
    EXPECT_EQ(link.LeastAge(received, observed_at), received - observed_at + absl::Seconds(990));
  }
}

TEST(RobotLinkTest, AReportCountsWhatItAdds) {
  const absl::Duration now = absl::Seconds(100);
  RobotLink link;
  EXPECT_EQ(link.OnReport({.fresh = 5, .held = 1}, /*is_new_session=*/true, now)->fresh, 5u);
  EXPECT_EQ(link.OnReport({.fresh = 5, .held = 1}, true, now)->fresh, 0u);
  EXPECT_EQ(link.OnReport({.fresh = 9, .held = 3}, true, now)->held, 2u);
  EXPECT_EQ(link.OnReport({.fresh = 7, .held = 3}, true, now)->fresh, 0u);
  RobotLink taken_over;
  EXPECT_EQ(taken_over.OnReport({.fresh = 9}, /*is_new_session=*/false, now)->fresh, 0u);
  EXPECT_EQ(taken_over.OnReport({.fresh = 12}, false, now)->fresh, 3u);
}

// At 50 Hz, 10 s are 1,000 beats at twice the rate.
TEST(RobotLinkTest, AReportOfMoreThanTheTimeAllowsCountsNothing) {
  const absl::Duration start = absl::Seconds(100);
  RobotLink link(absl::Milliseconds(20));
  EXPECT_FALSE(link.OnReport({.fresh = 1001}, true, start).has_value());
  EXPECT_EQ(
      link.OnReport({.fresh = 1051, .longest_gap_seconds = 12.0}, true, start + absl::Seconds(1))
          ->fresh,
      50u);
  // Many reports do not add up to more.
  uint64_t fresh = 1051;
  uint64_t counted = 0;
  for (int i = 0; i < 100; ++i) {
    const auto added = link.OnReport({.fresh = fresh += 100}, true, start + absl::Seconds(2));
    if (added.has_value()) counted += added->fresh;
  }
  EXPECT_EQ(counted, 1100u);
  // A link that was cut for a minute brings its beats at once, and the gap.
  const auto late =
      link.OnReport({.local = 3000, .longest_gap_seconds = 60.0}, true, start + absl::Seconds(62));
  EXPECT_EQ(late->local, 3000u);
  EXPECT_EQ(late->longest_gap_seconds, 60.0);
  EXPECT_EQ(
      link.OnReport({.local = 3000, .longest_gap_seconds = 60.0}, true, start + absl::Seconds(63))
          ->longest_gap_seconds,
      0.0);
}

// Counts `decisions` decisions with as many spikes as their index, and checks that the summary has
// each of them in one part.
void CheckLife(uint64_t first, uint64_t decisions) {
  SessionLife life(first, /*first_episode=*/0);
  for (uint64_t i = 0; i < decisions; ++i) {
    life.OnDecision(absl::Seconds(static_cast<double>(i)), i, /*seconds=*/1.0);
  }
  const auto parts = life.decisions();
  EXPECT_LE(parts.size(), ThinnedSeries<SessionLife::Decisions>::kPoints);
  uint64_t next = first;
  for (const auto& [begin, count, sum] : parts) {
    EXPECT_EQ(begin, next);
    EXPECT_LE(count, parts[0].count);
    next += count;
    const auto last = static_cast<double>(next - first - 1);
    EXPECT_FLOAT_EQ(sum.until, static_cast<float>(last));
    EXPECT_FLOAT_EQ(sum.seconds, static_cast<float>(count));
    // The sum of the indices from `begin` to the last one.
    EXPECT_FLOAT_EQ(sum.spikes,
                    static_cast<float>(static_cast<double>(count) *
                                       (static_cast<double>(begin - first) + last) / 2));
  }
  EXPECT_EQ(next, first + decisions);
}

TEST(SessionLifeTest, EveryDecisionIsInOnePart) {
  for (const uint64_t decisions : {0u, 1u, 23u, 24u, 25u, 47u, 48u, 49u, 1000u}) {
    CheckLife(0, decisions);
  }
}

TEST(SessionLifeTest, ARestoredSessionContinuesItsNumbers) { CheckLife(500, 30); }

TEST(SessionLifeTest, ReturnsAreAveraged) {
  SessionLife life(0, /*first_episode=*/2);
  EXPECT_EQ(life.ended_episodes(), 0u);
  for (int i = 0; i < 100; ++i) life.OnEpisode(i, /*target_return=*/0.0);
  EXPECT_EQ(life.ended_episodes(), 100u);
  EXPECT_EQ(life.mean_return(), 49.5);
  EXPECT_EQ(life.last_return(), 99.0);
  double sum = 0.0;
  for (const auto& [first, count, part] : life.episodes()) sum += part.episode_return;
  EXPECT_EQ(sum, 4950.0);
  EXPECT_EQ(life.episodes()[0].first, 2u);
}

class OperatorSeatTest : public ::testing::Test {
 protected:
  AgentSession NewAgent() { return {served_, NewSession("id", SmallOptions()), &clock_}; }

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

TEST_F(OperatorSeatTest, AnotherActionDoesNotConfirmTheHold) {
  AgentSession agent = NewAgent();
  agent.SetHold(std::make_shared<const Hold>(Hold{"h", ""}));
  Act(agent);
  const int64_t t = agent.session().step;
  ASSERT_TRUE(agent.Act(t, ObservationAt(t), RewardAt(t), ReportedAction(int64_t{1})).ok());
  EXPECT_FALSE(agent.is_at_neutral());
}

TEST_F(OperatorSeatTest, TheEndOfAnEpisodeConfirmsTheHold) {
  AgentSession agent = NewAgent();
  agent.SetHold(std::make_shared<const Hold>(Hold{"h", ""}));
  Act(agent);
  EXPECT_FALSE(agent.is_at_neutral());
  ASSERT_TRUE(agent.EndEpisode({.reward = 1.0, .terminated = true}).ok());
  EXPECT_TRUE(agent.is_at_neutral());
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
