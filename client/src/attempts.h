// Counts the failed attempts of one call, and decides what follows each of them: a pause, and the
// replica of the next attempt.
//
// Not thread-safe.
#pragma once

#include <cstdint>
#include <optional>
#include <set>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "client/src/replicas.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"
#include "spikeserve/unacknowledged.h"

namespace spikeserve {

// Returns whether another replica may have the session of a request that failed: this one does not
// know it, or misses more decisions than a session keeps. It wrote what it had once, after the
// store has lost the session. `decision` is that of the request; 0: it has none.
inline bool IsElsewhere(const absl::Status& error, uint64_t decision) {
  const auto expected = ExpectedDecision(error);
  return absl::IsNotFound(error) ||
         (expected.has_value() && *expected + Unacknowledged::kMostDecisions < decision);
}

class Attempts {
 public:
  // The arguments must outlive the object.
  Attempts(Replicas* replicas, Route* route, const RetryOptions& retry)
      : replicas_(replicas),
        route_(route),
        schedule_(retry, route->key),
        replica_(replicas->Choose(*route)) {}

  // The replica of the next attempt.
  Replica& replica() const { return *replica_; }
  Route& route() const { return *route_; }

  // Notes that `replica` answered the call.
  void Answered() { replicas_->Answered(*route_, *replica_); }

  // Notes that a part of the call was answered, so that the replicas are asked for another one now.
  void PartAnswered() { without_.clear(); }

  // Returns the delay before the call, or a part of it, is sent again to `replica`, or nothing if
  // there is no next attempt. Chooses another replica if `error` says that this one cannot answer
  // now. `timeout` is that of the failed attempt, `is_elsewhere` whether another replica may have
  // the session that the call names.
  //
  // Another replica may hold a session that the store has lost, and a session may move from one
  // that has not been asked yet to one that did not know it. So it is lost when all replicas say so
  // in a row.
  std::optional<absl::Duration> DelayAfter(const absl::Status& error, absl::Duration timeout,
                                           bool is_elsewhere) {
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

 private:
  Replicas* const replicas_;
  Route* const route_;
  RetrySchedule schedule_;
  std::set<const Replica*> tried_;
  std::set<const Replica*> without_;  // those that have denied the session in a row
  Replica* replica_;
};

}  // namespace spikeserve
