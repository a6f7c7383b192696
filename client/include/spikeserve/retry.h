// Repeats a call that failed for a temporary reason, with exponential backoff.
//
// Only for calls that change nothing, or that the server recognises when they are repeated.
#ifndef SPIKESERVE_RETRY_H_
#define SPIKESERVE_RETRY_H_

#include <functional>
#include <optional>
#include <random>
#include <string>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"

namespace spikeserve {

// The delay before attempt n + 1 is min(initial_backoff * multiplier^(n-1), max_backoff), times a
// random factor in [0.5, 1], so that callers that failed together do not retry together. If the
// server named the time of the next try (RetryAfter), the delay is that time and up to a tenth
// more.
struct RetryOptions {
  std::optional<int> max_attempts;  // 1: no retries; absent: limited by max_elapsed only
  // No attempt begins later than this after the first one. Outlasts the restart of a server.
  absl::Duration max_elapsed = absl::Seconds(30);
  absl::Duration initial_backoff = absl::Milliseconds(50);
  absl::Duration max_backoff = absl::Seconds(2);
  double multiplier = 2.0;
  std::function<void(absl::Duration)> sleep = absl::SleepFor;

  // Returns INVALID_ARGUMENT that names the field, the expected and the received value.
  absl::Status Validate() const;
};

// Returns true for UNAVAILABLE and DEADLINE_EXCEEDED, after which it is unknown whether the server
// carried out the call.
bool IsRetryable(const absl::Status& status);

// Returns true for RESOURCE_EXHAUSTED with the time of the next try: the server did not carry out
// the call.
bool IsRefusedForNow(const absl::Status& status);

// Decides what follows each failed attempt of one call. `key`, such as a session id, seeds the
// random factors of the delays: equal keys give equal delays.
class RetrySchedule {
 public:
  // `options` must outlive the schedule.
  RetrySchedule(const RetryOptions& options, const std::string& key);

  // Returns the delay before the next attempt, or nothing if there is none: after an error that
  // would repeat itself, after the last attempt, and if the delay would exceed max_elapsed.
  std::optional<absl::Duration> DelayAfter(const absl::Status& status);
  // As DelayAfter, after any error. `named` is the time of the next try that the server named.
  std::optional<absl::Duration> NextDelay(std::optional<absl::Duration> named);

 private:
  const RetryOptions& options_;
  std::minstd_rand random_;
  const absl::Duration start_;  // by the monotonic clock
  int attempts_ = 0;
  absl::Duration backoff_;
  absl::Duration delayed_;  // the sum of the delays
};

// Repeats `call` as RetrySchedule decides, and returns the last result.
absl::Status CallWithRetries(const RetryOptions& options, const std::string& key,
                             absl::FunctionRef<absl::Status()> call);

}  // namespace spikeserve

#endif  // SPIKESERVE_RETRY_H_
