// Tests of what a server knows of the link to a robot: how old observations are, and reports.
#include "core/agent/robot_link.h"

#include <gtest/gtest.h>

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

}  // namespace
}  // namespace spikeserve
