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
  gathered_ = delta_;
  guard_ = ReturnGuard::New(delta_);
  Publish();
}

std::shared_ptr<const FleetHead::Snapshot> FleetHead::Read() const {
  absl::MutexLock lock(&snapshot_mutex_);
  return snapshot_;
}

FleetHead::Member::Member(std::shared_ptr<FleetHead> head, std::string contributor)
    : head_(std::move(head)), contributor_(std::move(contributor)) {
  absl::MutexLock lock(&head_->mutex_);
  head_->budget_.Join(contributor_);
}

FleetHead::Member::~Member() {
  absl::MutexLock lock(&head_->mutex_);
  head_->budget_.Leave(contributor_);
}

UpdateOutcome FleetHead::Add(const Eigen::VectorXf& contribution) {
  const UpdateBounds bounds = {.clip = options_.clip,
                               .max_norm = options_.max_drift * BaseNorm(*policy_)};
  const bool gather = !guard_.has_reference && budget_.is_protected();
  return ApplyUpdate(1.0, contribution, bounds, gather ? &gathered_ : &delta_);
}

FleetHead::Merged FleetHead::Merge(const Eigen::VectorXf& contribution, double episode_return,
                                   const std::string& contributor, absl::Duration now,
                                   std::optional<size_t> members) {
  Merged merged;
  absl::MutexLock lock(&mutex_);
  if (members.has_value()) budget_.CountMembers(*members);
  // A caller without a name is no client.
  const bool accepted = contributor.empty() || budget_.Take(contributor, now);
  merged.outcome = accepted ? Add(contribution) : UpdateOutcome::kOverBudget;
  ++(merged.outcome == UpdateOutcome::kApplied ? updates_ : rejected_);
  if (merged.outcome != UpdateOutcome::kOverBudget) {
    merged.rolled_back = guard_.OnEpisode(episode_return, options_.guard_margin, &delta_);
    if (guard_.returns.empty()) EndWindow(merged.rolled_back);
  }
  if (merged.rolled_back) {
    updates_ = 0;
    ++rollbacks_;
  }
  Publish();
  merged.snapshot = Read();
  return merged;
}

void FleetHead::EndWindow(bool bad) {
  budget_.OnWindowEnd(bad);
  const double longest = options_.max_drift * BaseNorm(*policy_);
  ApplyUpdate(1.0, gathered_, {.clip = longest, .max_norm = longest}, &delta_);
  gathered_.setZero();
}

std::shared_ptr<const FleetHead::Snapshot> FleetHead::Rollback() {
  absl::MutexLock lock(&mutex_);
  std::shared_ptr<const Snapshot> before = Read();
  delta_.setZero();
  gathered_.setZero();
  budget_.OnWindowEnd(/*bad=*/false);
  guard_ = ReturnGuard::New(delta_);
  updates_ = 0;
  ++rollbacks_;
  Publish();
  return before;
}

std::vector<std::string> FleetHead::Members() const {
  absl::MutexLock lock(&mutex_);
  return budget_.Members();
}

FleetHead::State FleetHead::state() const {
  absl::MutexLock lock(&mutex_);
  return {.delta = delta_,
          .gathered = gathered_,
          .guard = guard_,
          .budget = budget_.state(),
          .updates = updates_,
          .rejected = rejected_,
          .rollbacks = rollbacks_};
}

void FleetHead::Restore(const State& state) {
  absl::MutexLock lock(&mutex_);
  delta_ = state.delta;
  gathered_ = state.gathered;
  guard_ = state.guard;
  budget_.Restore(state.budget);
  updates_ = state.updates;
  rejected_ = state.rejected;
  rollbacks_ = state.rollbacks;
  Publish();
}

bool FleetHead::IsPossible(const State& state) const {
  const auto size = static_cast<Eigen::Index>(policy_->weights.head.weight.values.size());
  return state.delta.size() == size && state.gathered.size() == size &&
         state.guard.beginning.size() == size && state.guard.good.size() == size &&
         state.guard.returns.size() < ReturnGuard::kWindow &&
         state.budget.contributors.size() == state.budget.accounts.size();
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
