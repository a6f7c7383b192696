#include "server/access/rate_limit.h"

#include <gtest/gtest.h>

#include <atomic>
#include <thread>
#include <vector>

#include "absl/time/time.h"

namespace spikeserve {
namespace {

int AcquireAllAt(RateLimit& limit, absl::Duration now) {
  int acquired = 0;
  while (acquired < 100'000 && limit.Acquire(now) == absl::ZeroDuration()) ++acquired;
  return acquired;
}

TEST(RateLimit, WithoutALimitNothingWaits) {
  RateLimit limit;
  for (int i = 0; i < 1000; ++i) EXPECT_EQ(limit.Acquire(absl::ZeroDuration()), absl::Duration());
}

TEST(RateLimit, LetsASecondsWorthThroughAtOnceAndThenTheRate) {
  RateLimit limit;
  limit.Set(50.0);
  EXPECT_EQ(AcquireAllAt(limit, absl::Seconds(100)), 50);
  EXPECT_EQ(AcquireAllAt(limit, absl::Seconds(100.1)), 5);
  EXPECT_EQ(AcquireAllAt(limit, absl::Seconds(110)), 50)
      << "a long idle time allows one burst only";
}

TEST(RateLimit, ARefusalNamesTheExactWaitAndCountsNothing) {
  RateLimit limit;
  limit.Set(10.0);
  const absl::Duration now = absl::Seconds(5);
  ASSERT_EQ(AcquireAllAt(limit, now), 10);
  for (int i = 0; i < 3; ++i) EXPECT_EQ(limit.Acquire(now), absl::Milliseconds(100));
  EXPECT_NE(limit.Acquire(now + absl::Milliseconds(99)), absl::ZeroDuration());
  EXPECT_EQ(limit.Acquire(now + absl::Milliseconds(100)), absl::ZeroDuration());
}

TEST(RateLimit, BelowOneASecondStillLetsOneThrough) {
  RateLimit limit;
  limit.Set(0.25);
  EXPECT_EQ(AcquireAllAt(limit, absl::Seconds(1)), 1);
  EXPECT_EQ(limit.Acquire(absl::Seconds(1)), absl::Seconds(4));
  EXPECT_EQ(AcquireAllAt(limit, absl::Seconds(5)), 1);
}

TEST(RateLimit, ANewLimitHoldsFromTheNextEventOn) {
  RateLimit limit;
  limit.Set(1.0);
  ASSERT_EQ(AcquireAllAt(limit, absl::Seconds(1)), 1);
  limit.Set(0.0);
  EXPECT_EQ(limit.Acquire(absl::Seconds(1)), absl::ZeroDuration());
  limit.Set(100.0);
  EXPECT_EQ(AcquireAllAt(limit, absl::Seconds(60)), 100);
}

TEST(RateLimit, ThreadsTogetherGetNoMoreThanOne) {
  RateLimit limit;
  limit.Set(1000.0);
  std::atomic<int> acquired = 0;
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&] {
      for (int k = 0; k < 1000; ++k)
        acquired += limit.Acquire(absl::Seconds(1)) == absl::Duration();
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(acquired, 1000);
}

}  // namespace
}  // namespace spikeserve
