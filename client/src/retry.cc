#include "spikeserve/retry.h"

#include <algorithm>
#include <random>

#include "absl/strings/str_cat.h"
#include "client/src/steady_time.h"
#include "spikeserve/status.h"

namespace spikeserve {

absl::Status RetryOptions::Validate() const {
  if (max_attempts.has_value() && *max_attempts < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("max_attempts: expected at least 1, received ", *max_attempts));
  }
  if (max_elapsed < absl::ZeroDuration()) {
    return absl::InvalidArgumentError(absl::StrCat("max_elapsed: expected at least 0, received ",
                                                   absl::FormatDuration(max_elapsed)));
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

bool IsRefusedForNow(const absl::Status& status) {
  return absl::IsResourceExhausted(status) && RetryAfter(status).has_value();
}

RetrySchedule::RetrySchedule(const RetryOptions& options, const std::string& key)
    : options_(options),
      random_(std::hash<std::string>()(key)),
      start_(SteadyNow()),
      backoff_(options.initial_backoff) {}

std::optional<absl::Duration> RetrySchedule::DelayAfter(const absl::Status& status) {
  if (!IsRetryable(status) && !IsRefusedForNow(status)) return std::nullopt;
  return NextDelay(RetryAfter(status));
}

std::optional<absl::Duration> RetrySchedule::NextDelay(std::optional<absl::Duration> named) {
  ++attempts_;
  if (options_.max_attempts.has_value() && attempts_ >= *options_.max_attempts) return std::nullopt;
  absl::Duration delay;
  if (named.has_value()) {
    delay = *named * std::uniform_real_distribution<double>(1.0, 1.1)(random_);
  } else {
    delay = backoff_ * std::uniform_real_distribution<double>(0.5, 1.0)(random_);
    backoff_ = std::min(backoff_ * options_.multiplier, options_.max_backoff);
  }
  // The sum counts in place of the clock if `sleep` does not sleep.
  const absl::Duration elapsed = std::max(SteadyNow() - start_, delayed_);
  if (elapsed + delay > options_.max_elapsed) return std::nullopt;
  delayed_ += delay;
  return delay;
}

absl::Status CallWithRetries(const RetryOptions& options, const std::string& key,
                             absl::FunctionRef<absl::Status()> call) {
  RetrySchedule schedule(options, key);
  while (true) {
    const absl::Status status = call();
    const auto delay = schedule.DelayAfter(status);
    if (!delay.has_value()) return status;
    options.sleep(*delay);
  }
}

}  // namespace spikeserve
