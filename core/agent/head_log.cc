#include "core/agent/head_log.h"

#include "core/agent/served_policy.h"

namespace spikeserve {

FleetContribution::FleetContribution(std::shared_ptr<const ServedPolicy> served,
                                     std::string session, std::string head, std::string contributor,
                                     bool held_out,
                                     std::shared_ptr<const PendingContribution> pending)
    : served_(std::move(served)),
      session_(std::move(session)),
      head_(std::move(head)),
      contributor_(std::move(contributor)),
      held_out_(held_out),
      pending_(std::move(pending)) {}

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

void FleetContribution::OnMerged(const MergeOutcome& outcome, bool is_new) {
  LearningSummary summary = pending_->summary;
  if (!outcome.paused && IsRefusedByFleet(outcome.update)) {
    summary.rejected += std::exchange(summary.updates, 0);
  }
  summary.rolled_back = outcome.rolled_back;
  summary.head_drift = outcome.drift;
  summary.watched_return = outcome.watched_return;
  std::vector<Done> waiters;
  {
    absl::MutexLock lock(&mutex_);
    if (merged_.has_value()) return;
    merged_ = summary;
    waiters.swap(waiters_);
  }
  if (is_new) {
    if (!outcome.paused) served_->observer->OnHeadUpdate(outcome.update);
    served_->observer->OnLearned(summary);
  }
  for (const Done& done : waiters) done(absl::OkStatus());
}

void FleetContribution::OnUnreachable(const absl::Status& status) {
  std::vector<Done> waiters;
  {
    absl::MutexLock lock(&mutex_);
    waiters.swap(waiters_);
  }
  for (const Done& done : waiters) done(status);
}

}  // namespace spikeserve
