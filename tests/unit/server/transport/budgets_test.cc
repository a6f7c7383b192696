#include <gtest/gtest.h>

#include "server/base/byte_budget.h"
#include "server/transport/frame_budget.h"
#include "server/transport/limits.h"

namespace spikeserve {
namespace {

// Returns how many frames pass at `now`.
int Frames(FrameBudget* budget, absl::Duration now) {
  int frames = 0;
  while (frames < 1000 && budget->Take(now)) ++frames;
  return frames;
}

TEST(FrameBudgetTest, HoldsOneSecond) {
  FrameBudget budget(10);
  EXPECT_EQ(Frames(&budget, absl::Seconds(100)), 20);  // full at first, and refilled once
  EXPECT_EQ(Frames(&budget, absl::Milliseconds(100'500)), 5);
  EXPECT_EQ(Frames(&budget, absl::Seconds(200)), 10);
}

TEST(FrameBudgetTest, EarnsWhatThePeerMayAnswer) {
  FrameBudget budget(10);
  Frames(&budget, absl::Seconds(100));
  budget.Earn();
  EXPECT_EQ(Frames(&budget, absl::Seconds(100)), 4);
}

TEST(ByteBudgetTest, Bounds) {
  ByteBudget budget;
  EXPECT_TRUE(budget.Count(60, 100));
  EXPECT_FALSE(budget.Count(41, 100));
  EXPECT_EQ(budget.used(), 101);
  EXPECT_TRUE(budget.Count(-41, 100));
  EXPECT_TRUE(budget.Count(40, 100));
  EXPECT_TRUE(budget.Count(-100, 0));
  EXPECT_EQ(budget.used(), 0);
}

TEST(TransportLimitsTest, ErrorsNameTheFlag) {
  EXPECT_TRUE(TransportLimits().Validate().ok());
  TransportLimits limits;
  limits.max_streams = 0;
  EXPECT_EQ(limits.Validate().message(), "--max_streams: expected at least 1, received 0");
  limits = {};
  limits.idle_timeout = absl::ZeroDuration();
  EXPECT_EQ(limits.Validate().message(), "--idle_timeout: expected at least 1ms, received 0");
}

}  // namespace
}  // namespace spikeserve
