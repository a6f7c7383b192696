#include "spikeserve/retry.h"

#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "spikeserve/status.h"

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

TEST_F(RetryTest, ReturnsTheFirstSuccess) {
  int calls = 0;
  EXPECT_TRUE(CallWithRetries(Options(), "key", [&] {
                return ++calls == 3 ? absl::OkStatus() : absl::UnavailableError("busy");
              }).ok());
  EXPECT_EQ(calls, 3);
  EXPECT_EQ(pauses_.size(), 2u);
}

TEST_F(RetryTest, GivesUpWithTheLastError) {
  int calls = 0;
  const absl::Status status = CallWithRetries(Options(), "key", [&] {
    ++calls;
    return absl::DeadlineExceededError("late");
  });
  EXPECT_EQ(status, absl::DeadlineExceededError("late"));
  EXPECT_EQ(calls, 6);
  EXPECT_EQ(pauses_.size(), 5u);
}

TEST_F(RetryTest, NeverRepeatsWhatWouldFailAgain) {
  int calls = 0;
  const absl::Status status = CallWithRetries(Options(), "key", [&] {
    ++calls;
    return absl::InvalidArgumentError("observation: expected 4 values, received 3");
  });
  EXPECT_TRUE(absl::IsInvalidArgument(status));
  EXPECT_EQ(calls, 1);
  EXPECT_TRUE(pauses_.empty());
}

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

}  // namespace
}  // namespace spikeserve
