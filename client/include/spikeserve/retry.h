// Repeating a call that may have failed for no lasting reason, with exponential backoff.
//
// Only for calls that the server recognises when they come twice, or that change nothing.
#ifndef SPIKESERVE_RETRY_H_
#define SPIKESERVE_RETRY_H_

#include <functional>
#include <string>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"

namespace spikeserve {

// The pause before attempt n + 1 is initial_backoff * multiplier^(n-1), at most max_backoff, times
// a factor in [0.5, 1] that spreads out callers who failed together.
struct RetryOptions {
  int max_attempts = 5;  // 1: never repeat
  absl::Duration initial_backoff = absl::Milliseconds(50);
  absl::Duration max_backoff = absl::Seconds(2);
  double multiplier = 2.0;
  std::function<void(absl::Duration)> sleep = absl::SleepFor;

  // INVALID_ARGUMENT names the field, what was expected and what came.
  absl::Status Validate() const;
};

// UNAVAILABLE and DEADLINE_EXCEEDED: nobody knows whether the call was carried out.
bool IsRetryable(const absl::Status& status);

// Calls until the result is not retryable or the attempts are used up, and returns the last result.
// Callers with different keys (a session id) draw different spreads; the same key draws the same
// ones.
absl::Status CallWithRetries(const RetryOptions& options, const std::string& key,
                             absl::FunctionRef<absl::Status()> call);

}  // namespace spikeserve

#endif  // SPIKESERVE_RETRY_H_
