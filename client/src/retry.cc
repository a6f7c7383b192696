#include "spikeserve/retry.h"

#include <algorithm>
#include <random>

#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::Status RetryOptions::Validate() const {
  if (max_attempts < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("max_attempts: expected at least 1, received ", max_attempts));
  }
  if (initial_backoff < absl::ZeroDuration()) {
    return absl::InvalidArgumentError(absl::StrCat(
        "initial_backoff: expected at least 0, received ", absl::FormatDuration(initial_backoff)));
  }
  if (max_backoff < initial_backoff) {
    return absl::InvalidArgumentError(absl::StrCat(
        "max_backoff: expected at least initial_backoff (", absl::FormatDuration(initial_backoff),
        "), received ", absl::FormatDuration(max_backoff)));
  }
  if (!(multiplier >= 1.0)) {
    return absl::InvalidArgumentError(
        absl::StrCat("multiplier: expected at least 1, received ", multiplier));
  }
  if (!sleep) return absl::InvalidArgumentError("sleep: expected a function, received none");
  return absl::OkStatus();
}

bool IsRetryable(const absl::Status& status) {
  return absl::IsUnavailable(status) || absl::IsDeadlineExceeded(status);
}

absl::Status CallWithRetries(const RetryOptions& options, const std::string& key,
                             absl::FunctionRef<absl::Status()> call) {
  std::minstd_rand random(std::hash<std::string>()(key));
  std::uniform_real_distribution<double> spread(0.5, 1.0);
  absl::Duration backoff = options.initial_backoff;
  for (int attempt = 1;; ++attempt) {
    const absl::Status status = call();
    if (!IsRetryable(status) || attempt >= options.max_attempts) return status;
    options.sleep(backoff * spread(random));
    backoff = std::min(backoff * options.multiplier, options.max_backoff);
  }
}

}  // namespace spikeserve
