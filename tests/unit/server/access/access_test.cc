#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <fstream>
#include <thread>
#include <vector>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/time/time.h"
#include "server/access/authenticator.h"
#include "server/access/rate_limit.h"
#include "server/access/refusal_pacer.h"
#include "tests/support/files.h"

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

std::string Entry(absl::string_view token, absl::string_view role) {
  const Digest digest = Sha256(token);
  const std::string hash =
      absl::BytesToHexString({reinterpret_cast<const char*>(digest.data()), digest.size()});
  return absl::StrCat(R"({"sha256": ")", hash, R"(", "tenant": "fleet", "role": ")", role, "\"}");
}

TEST(AuthenticatorTest, RefusalsArePacedByTenant) {
  const TemporaryDirectory directory;
  const std::string path = (directory.path() / "tokens.json").string();
  std::ofstream(path) << R"({"tenants": {"fleet": {}}, "tokens": [)" << Entry("a", "agent") << ","
                      << Entry("b", "viewer") << "]}";
  const auto authenticator = Authenticator::Create(path);
  ASSERT_TRUE(authenticator.ok()) << authenticator.status();
  const auto refusals = [&](absl::string_view token) {
    return &(*authenticator)->RefusalPacerFor((*authenticator)->Authenticate(token));
  };
  EXPECT_EQ(refusals("a"), refusals("b"));
  EXPECT_EQ(refusals("wrong"), refusals("none of them"));
  EXPECT_NE(refusals("a"), refusals("wrong"));
}

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
