#include <map>
#include <set>
#include <vector>

#include "client/src/replicas.h"
#include "client/tools/latency_histogram.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

// A fixture whose options record the pauses instead of sleeping.
class RetryTest : public ::testing::Test {
 protected:
  RetryOptions Options() {
    RetryOptions options;
    options.max_attempts = 6;
    options.initial_backoff = absl::Milliseconds(100);
    options.max_backoff = absl::Milliseconds(400);
    options.sleep = [this](absl::Duration pause) { pauses_.push_back(pause); };
    return options;
  }

  std::vector<absl::Duration> pauses_;
};

TEST_F(RetryTest, BacksOffExponentiallyUpToTheLimit) {
  (void)CallWithRetries(Options(), "key", [] { return absl::UnavailableError("busy"); });
  const std::vector<int> full = {100, 200, 400, 400, 400};
  ASSERT_EQ(pauses_.size(), full.size());
  for (size_t i = 0; i < full.size(); ++i) {
    EXPECT_GE(pauses_[i], absl::Milliseconds(full[i]) / 2) << i;
    EXPECT_LE(pauses_[i], absl::Milliseconds(full[i])) << i;
  }
}

TEST_F(RetryTest, OutlastsARestartByDefault) {
  RetryOptions options;
  absl::Duration paused;
  options.sleep = [&](absl::Duration pause) { paused += pause; };
  (void)CallWithRetries(options, "key", [] { return absl::UnavailableError("busy"); });
  EXPECT_LE(paused, absl::Seconds(30));
  EXPECT_GT(paused, absl::Seconds(27));
}

TEST_F(RetryTest, WaitsAsLongAsTheServerAsks) {
  constexpr int kResourceExhausted = 8;
  int calls = 0;
  EXPECT_TRUE(CallWithRetries(Options(), "key", [&] {
                return ++calls == 2 ? absl::OkStatus()
                                    : StatusFromCode(kResourceExhausted, "full", /*retry=*/3.0);
              }).ok());
  ASSERT_EQ(pauses_.size(), 1u);
  EXPECT_GE(pauses_[0], absl::Seconds(3));
  EXPECT_LE(pauses_[0], absl::Seconds(3.3));
  // Without the time of the next try, a limit does not pass by waiting.
  calls = 0;
  (void)CallWithRetries(Options(), "key", [&] {
    ++calls;
    return absl::ResourceExhaustedError("full");
  });
  EXPECT_EQ(calls, 1);
  // A pause that does not fit into the time is not begun.
  const absl::Status status = CallWithRetries(
      Options(), "key", [] { return StatusFromCode(kResourceExhausted, "full", 60.0); });
  EXPECT_EQ(RetryAfter(status), absl::Seconds(60));
  EXPECT_EQ(pauses_.size(), 1u);
}

TEST_F(RetryTest, DifferentKeysSpreadDifferently) {
  (void)CallWithRetries(Options(), "session-1", [] { return absl::UnavailableError("busy"); });
  const std::vector<absl::Duration> first = std::exchange(pauses_, {});
  (void)CallWithRetries(Options(), "session-2", [] { return absl::UnavailableError("busy"); });
  EXPECT_NE(first, pauses_);
}

TEST(RetryOptionsTest, ValidateNamesTheField) {
  const auto message = [](auto change) {
    RetryOptions options;
    change(options);
    const absl::Status status = options.Validate();
    EXPECT_TRUE(absl::IsInvalidArgument(status));
    return std::string(status.message());
  };
  EXPECT_TRUE(RetryOptions().Validate().ok());
  EXPECT_EQ(message([](RetryOptions& o) { o.max_attempts = 0; }),
            "max_attempts: expected at least 1, received 0");
  EXPECT_THAT(message([](RetryOptions& o) { o.max_elapsed = absl::Seconds(-1); }),
              HasSubstr("max_elapsed"));
  EXPECT_THAT(message([](RetryOptions& o) { o.initial_backoff = absl::Seconds(-1); }),
              HasSubstr("initial_backoff"));
  EXPECT_THAT(message([](RetryOptions& o) { o.max_backoff = absl::Milliseconds(1); }),
              HasSubstr("max_backoff"));
  EXPECT_THAT(message([](RetryOptions& o) { o.multiplier = 0.5; }), HasSubstr("multiplier"));
  EXPECT_THAT(message([](RetryOptions& o) { o.sleep = nullptr; }), HasSubstr("sleep"));
}

// The Python client computes the same numbers: tests/python/client/test_replicas.py.
TEST(ReplicasTest, AllClientsRankTheServersEqually) {
  const std::string key = "0123456789abcdef0123456789abcdef";
  EXPECT_EQ(Rank(key, "10.0.0.1:50051"), 15574301511887128372u);
  EXPECT_EQ(Rank(key, "unix:/a"), 15821398357803811023u);
}

TEST(ReplicasTest, ParsesAddresses) {
  const auto servers = ParseServers("10.0.0.1:50051, unix:/run/spikeserve.sock");
  ASSERT_TRUE(servers.ok()) << servers.status();
  EXPECT_EQ(*servers, (std::vector<std::string>{"10.0.0.1:50051", "unix:/run/spikeserve.sock"}));
  EXPECT_EQ(ParseServers("a:1,,b:2").status().message(),
            "server: expected HOST:PORT or unix:PATH, several separated by commas, received "
            "\"a:1,,b:2\"");
}

class FakeReplicasTest : public ::testing::Test {
 protected:
  FakeReplicasTest() {
    std::vector<std::unique_ptr<Replica>> all;
    int i = 0;
    for (const FakePolicyService& fake : fakes_) {
      all.push_back(std::make_unique<Replica>(std::string(1, static_cast<char>('a' + i++)),
                                              fake.channel(), nullptr));
      present_.insert(all.back().get());
    }
    replicas_ = std::make_unique<Replicas>(std::move(all), absl::Hours(1), absl::Hours(1));
  }

  FakePolicyService fakes_[3];
  std::set<const Replica*> present_;
  std::unique_ptr<Replicas> replicas_;
};

TEST_F(FakeReplicasTest, SessionsAreSpreadAndReturnToTheirReplica) {
  std::map<const Replica*, int> sessions;
  for (int i = 0; i < 300; ++i) {
    Route route(DrawId());
    Replica* const preferred = replicas_->Choose(route);
    ++sessions[preferred];
    replicas_->Failed(*preferred);
    EXPECT_NE(replicas_->Choose(route), preferred);
    replicas_->Answered(route, *preferred);
    EXPECT_EQ(replicas_->Choose(route), preferred);
  }
  EXPECT_EQ(sessions.size(), 3u);
  for (const auto& [replica, count] : sessions) EXPECT_GT(count, 50) << replica->address;
}

TEST_F(FakeReplicasTest, AllAreTriedBeforeOneIsTriedAgain) {
  Route route(DrawId());
  std::set<const Replica*> tried;
  for (int i = 0; i < 3; ++i) {
    Replica* const replica = replicas_->Choose(route, tried);
    EXPECT_TRUE(tried.insert(replica).second);
    replicas_->Failed(*replica);
  }
  EXPECT_EQ(tried, present_);
  EXPECT_NE(replicas_->Choose(route, tried), nullptr);
}

TEST_F(FakeReplicasTest, APinnedRouteStays) {
  Route route(DrawId());
  Replica* const home = replicas_->Choose(route);
  replicas_->Answered(route, *home);
  EXPECT_TRUE(replicas_->MayMove(route));
  replicas_->Pin(route, true);
  replicas_->Failed(*home);
  EXPECT_EQ(replicas_->Choose(route), home);
  EXPECT_EQ(replicas_->PinnedTo(route), home);
  EXPECT_FALSE(replicas_->MayMove(route));
}

TEST_F(FakeReplicasTest, AShortSilenceLeadsToACheckOnly) {
  Route route(DrawId());
  Replica* const preferred = replicas_->Choose(route);
  replicas_->Failed(*preferred, kProbeTimeout / 2);
  EXPECT_EQ(replicas_->Choose(route), preferred);
  replicas_->Failed(*preferred, kProbeTimeout);
  EXPECT_NE(replicas_->Choose(route), preferred);
}

TEST(LatencyHistogramTest, QuantilesAreWithinOnePercent) {
  LatencyHistogram histogram;
  for (int i = 1; i <= 1000; ++i) histogram.Add(i * 1e-5);
  EXPECT_EQ(histogram.count(), 1000);
  EXPECT_NEAR(histogram.Quantile(0.5), 500e-5, 5e-5);
  EXPECT_NEAR(histogram.Quantile(0.99), 990e-5, 9.9e-5);
  EXPECT_NEAR(histogram.Quantile(0.0), 1e-5, 1e-7);
  EXPECT_NEAR(histogram.Quantile(1.0), 1000e-5, 10e-5);
}

TEST(LatencyHistogramTest, MergeIsAddingAll) {
  LatencyHistogram all, first, second;
  for (int i = 1; i <= 100; ++i) {
    all.Add(i * 1e-3);
    (i % 3 == 0 ? first : second).Add(i * 1e-3);
  }
  LatencyHistogram merged;
  merged.Merge(first);
  merged.Merge(second);
  merged.Merge(LatencyHistogram());
  EXPECT_EQ(merged.count(), 100);
  for (const double quantile : {0.0, 0.5, 0.9, 0.99, 1.0}) {
    EXPECT_EQ(merged.Quantile(quantile), all.Quantile(quantile));
  }
}

}  // namespace
}  // namespace spikeserve
