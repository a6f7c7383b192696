#include "server/access/refusal_pacer.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <thread>
#include <vector>

namespace spikeserve {
namespace {

constexpr size_t kMiB = 1 << 20;
const absl::Status kRefusal = absl::ResourceExhaustedError("too much");
const absl::Duration kLongestAlone = absl::Milliseconds(150);

TEST(RefusalPacerTest, WhatIsNoRefusalIsNotSlowedDown) {
  RefusalPacer pacer;
  for (const absl::Status& status :
       {absl::OkStatus(), absl::NotFoundError(""), absl::InvalidArgumentError(""),
        absl::FailedPreconditionError(""), absl::UnavailableError("")}) {
    EXPECT_EQ(pacer.DelayFor(status, 5 * kMiB, absl::Seconds(7)), absl::ZeroDuration());
  }
}

TEST(RefusalPacerTest, WhoIsRefusedAloneWaitsForATenthOfASecond) {
  absl::Duration sum;
  for (int i = 0; i < 1000; ++i) {
    RefusalPacer pacer;
    const absl::Duration rest = pacer.DelayFor(kRefusal, 20 * kMiB, absl::Seconds(i));
    EXPECT_GE(rest, absl::Milliseconds(50));
    EXPECT_LT(rest, kLongestAlone);
    sum += rest;
  }
  EXPECT_GT(sum, absl::Seconds(95));
  EXPECT_LT(sum, absl::Seconds(105));
}

TEST(RefusalPacerTest, HoweverManyAskSoManyASecondHaveTheirRefusal) {
  RefusalPacer pacer;
  std::vector<absl::Duration> rests;
  for (int i = 0; i < 900; ++i) rests.push_back(pacer.DelayFor(kRefusal, 0, absl::Seconds(3)));
  std::sort(rests.begin(), rests.end());
  for (int second = 0; second < 2; ++second) {
    const auto from = std::lower_bound(rests.begin(), rests.end(), absl::Seconds(second));
    const auto to = std::lower_bound(rests.begin(), rests.end(), absl::Seconds(second + 1));
    EXPECT_LE(to - from, 550) << "from second " << second;
  }
  EXPECT_LT(pacer.DelayFor(kRefusal, 0, absl::Seconds(3 + 2)), kLongestAlone)
      << "the queue is empty again";
}

TEST(RefusalPacerTest, NobodyWaitsForever) {
  RefusalPacer pacer;
  for (int i = 0; i < 100'000; ++i) {
    ASSERT_LE(pacer.DelayFor(kRefusal, 0, absl::ZeroDuration()), absl::Seconds(2) + kLongestAlone);
  }
  EXPECT_LT(pacer.DelayFor(kRefusal, 0, absl::Seconds(2.1)), kLongestAlone) << "the queue is over";
}

TEST(RefusalPacerTest, LongRequestsAreLongTurns) {
  RefusalPacer pacer;
  EXPECT_LT(pacer.DelayFor(kRefusal, 4 * kMiB, absl::ZeroDuration()), kLongestAlone);
  const absl::Duration second = pacer.DelayFor(kRefusal, 4 * kMiB, absl::ZeroDuration());
  EXPECT_GE(second, absl::Milliseconds(1052));
  EXPECT_LT(second, absl::Milliseconds(1152));
}

TEST(RefusalPacerTest, ThreadsTakeTurns) {
  RefusalPacer pacer;
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&] {
      for (int k = 0; k < 100; ++k) pacer.DelayFor(kRefusal, 0, absl::ZeroDuration());
    });
  }
  for (std::thread& thread : threads) thread.join();
  const absl::Duration next = pacer.DelayFor(kRefusal, 0, absl::ZeroDuration());
  EXPECT_GE(next, absl::Milliseconds(850));
  EXPECT_LT(next, absl::Milliseconds(950));
}

}  // namespace
}  // namespace spikeserve
