#include "core/agent/head_log.h"

#include "core/agent/served_policy.h"

namespace spikeserve {

void FleetContribution::Append() {
  {
    absl::MutexLock lock(&mutex_);
    if (std::exchange(appended_, true)) return;
  }
  served_->log->Append(shared_from_this());
}

std::optional<LearningSummary> FleetContribution::merged() const {
  absl::MutexLock lock(&mutex_);
  return merged_;
}

void FleetContribution::WhenMerged(Done done) {
  {
    absl::MutexLock lock(&mutex_);
    if (!merged_.has_value()) {
      waiters_.push_back(std::move(done));
      return;
    }
  }
  done(absl::OkStatus());
}

void FleetContribution::OnOutcome(const absl::StatusOr<MergeOutcome>& outcome, bool is_new) {
  LearningSummary summary = value_.summary;
  if (outcome.ok()) TakeOutcome(*outcome, &summary);
  std::vector<Done> waiters;
  {
    absl::MutexLock lock(&mutex_);
    if (merged_.has_value()) return;
    if (outcome.ok()) merged_ = summary;
    waiters.swap(waiters_);
  }
  if (is_new) {
    if (!outcome->paused) served_->observer->OnHeadUpdate(outcome->update);
    served_->observer->OnLearned(summary);
  }
  for (const Done& done : waiters) done(outcome.status());
}

}  // namespace spikeserve
