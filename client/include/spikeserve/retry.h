// Repeats a call that failed for a temporary reason, with exponential backoff.
//
// Only for calls that change nothing, or that the server recognises when they are repeated.
#ifndef SPIKESERVE_RETRY_H_
#define SPIKESERVE_RETRY_H_

#include <functional>
#include <string>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"

namespace spikeserve {

// The delay before attempt n + 1 is min(initial_backoff * multiplier^(n-1), max_backoff), times a
// random factor in [0.5, 1], so that callers that failed together do not retry together.
struct RetryOptions {
  int max_attempts = 5;  // 1: no retries
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

// Repeats `call` until its result is not retryable or max_attempts are made, and returns the last
// result. `key`, such as a session id, seeds the random factors of the delays: equal keys give
// equal delays.
absl::Status CallWithRetries(const RetryOptions& options, const std::string& key,
                             absl::FunctionRef<absl::Status()> call);

}  // namespace spikeserve

#endif  // SPIKESERVE_RETRY_H_
