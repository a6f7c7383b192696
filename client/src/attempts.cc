#include "client/src/attempts.h"

#include "spikeserve/status.h"
#include "spikeserve/unacknowledged.h"

namespace spikeserve {

bool IsElsewhere(const absl::Status& error, uint64_t decision) {
  const auto expected = ExpectedDecision(error);
  return absl::IsNotFound(error) ||
         (expected.has_value() && *expected + Unacknowledged::kMostDecisions < decision);
}

Attempts::Attempts(Replicas* replicas, Route* route, const RetryOptions& retry)
    : replicas_(replicas),
      route_(route),
      schedule_(retry, route->key),
      replica_(replicas->Choose(*route)) {}

std::optional<absl::Duration> Attempts::DelayAfter(const absl::Status& error,
                                                   absl::Duration timeout, bool is_elsewhere) {
  if (!replicas_->MayMove(*route_) || !(is_elsewhere || IsRetryable(error))) {
    return schedule_.DelayAfter(error);
  }
  if (is_elsewhere) {
    without_.insert(replica_);
    if (without_.size() == replicas_->size()) return std::nullopt;
  } else {
    without_.clear();
    const bool is_silent = absl::IsDeadlineExceeded(error);
    is_silent ? replicas_->Failed(*replica_, timeout) : replicas_->Failed(*replica_);
  }
  tried_.insert(replica_);
  const bool all_tried = tried_.size() == replicas_->size();
  if (all_tried) tried_ = without_;
  replica_ = replicas_->Choose(*route_, tried_);
  return schedule_.NextDelay(all_tried ? RetryAfter(error) : std::nullopt);
}

}  // namespace spikeserve
