#include "server/rpc/call_tracker.h"

#include <gtest/gtest.h>

#include <thread>

namespace spikeserve {
namespace {

struct FakeStream : CallTracker::Stream {
  int drained = 0;
  void Drain() override { ++drained; }
};

TEST(CallTrackerTest, CallsAreRefusedOnceItDrains) {
  CallTracker calls;
  EXPECT_TRUE(calls.Begin());
  calls.End();
  calls.Drain();
  EXPECT_FALSE(calls.Begin());
  EXPECT_FALSE(calls.WaitUntilIdle(absl::ZeroDuration()));
  calls.End();
  EXPECT_TRUE(calls.WaitUntilIdle(absl::ZeroDuration()));
}

TEST(CallTrackerTest, OnlyOpenStreamsAreTold) {
  CallTracker calls;
  const auto ended = std::make_shared<FakeStream>();
  const auto open = std::make_shared<FakeStream>();
  const auto late = std::make_shared<FakeStream>();
  EXPECT_TRUE(calls.BeginStream(ended));
  EXPECT_TRUE(calls.BeginStream(open));
  calls.EndStream(ended.get());
  calls.Drain();
  EXPECT_FALSE(calls.BeginStream(late));
  EXPECT_EQ(ended->drained, 0);
  EXPECT_EQ(open->drained, 1);
  EXPECT_EQ(late->drained, 0);
  calls.EndStream(open.get());
  EXPECT_FALSE(calls.WaitUntilIdle(absl::ZeroDuration()));
  calls.EndStream(late.get());
  EXPECT_TRUE(calls.WaitUntilIdle(absl::ZeroDuration()));
}

TEST(CallTrackerTest, WaitingEndsWithTheLastCall) {
  CallTracker calls;
  calls.Begin();
  calls.Begin();
  calls.End();
  std::thread last([&] { calls.End(); });
  EXPECT_TRUE(calls.WaitUntilIdle(absl::Minutes(1)));
  last.join();
}

}  // namespace
}  // namespace spikeserve
