#include "core/learning/fleet_head.h"

#include <utility>

#include "core/learning/frobenius_norm.h"
#include "core/learning/learner.h"
#include "core/math/vector_view.h"

namespace spikeserve {

FleetHead::FleetHead(std::shared_ptr<const Policy> policy, FleetOptions options)
    : policy_(std::move(policy)), options_(options) {
  absl::MutexLock lock(&mutex_);
  delta_.setZero(AsVector(policy_->weights.head.weight.values).size());
  guard_ = ReturnGuard::New(delta_);
  Publish();
}

std::shared_ptr<const FleetHead::Snapshot> FleetHead::Read() const {
  absl::MutexLock lock(&snapshot_mutex_);
  return snapshot_;
}

FleetHead::Merged FleetHead::Merge(const Eigen::VectorXf& contribution, double episode_return) {
  const UpdateBounds bounds = {.clip = options_.clip,
                               .max_norm = options_.max_drift * BaseNorm(*policy_)};
  Merged merged;
  absl::MutexLock lock(&mutex_);
  merged.outcome = ApplyUpdate(1.0, contribution, bounds, &delta_);
  ++(merged.outcome == UpdateOutcome::kApplied ? updates_ : rejected_);
  merged.rolled_back = guard_.OnEpisode(episode_return, options_.guard_margin, &delta_);
  if (merged.rolled_back) {
    updates_ = 0;
    ++rollbacks_;
  }
  Publish();
  merged.snapshot = Read();
  return merged;
}

std::shared_ptr<const FleetHead::Snapshot> FleetHead::Rollback() {
  absl::MutexLock lock(&mutex_);
  std::shared_ptr<const Snapshot> before = Read();
  delta_.setZero();
  guard_ = ReturnGuard::New(delta_);
  updates_ = 0;
  ++rollbacks_;
  Publish();
  return before;
}

void FleetHead::Publish() {
  auto next =
      std::make_shared<const Snapshot>(Snapshot{.head = HeadWith(*policy_, delta_),
                                                .delta = delta_,
                                                .drift = FrobeniusNorm(delta_) / BaseNorm(*policy_),
                                                .updates = updates_,
                                                .rejected = rejected_,
                                                .rollbacks = rollbacks_,
                                                .level = guard_.last});
  absl::MutexLock lock(&snapshot_mutex_);
  snapshot_.swap(next);  // the snapshot before is freed after the lock is released
}

}  // namespace spikeserve
