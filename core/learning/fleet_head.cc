#include "core/learning/fleet_head.h"

#include <algorithm>
#include <utility>

#include "core/contract/dcheck.h"
#include "core/learning/frobenius_norm.h"
#include "core/learning/held_out.h"
#include "core/learning/learner.h"
#include "core/math/vector_view.h"

namespace spikeserve {

FleetHead::FleetHead(std::shared_ptr<const Policy> policy, FleetOptions options,
                     const HeldOutKey& held_out_key)
    : policy_(std::move(policy)), options_(options), held_out_key_(held_out_key) {
  absl::MutexLock lock(&mutex_);
  delta_.setZero(AsVector(policy_->weights.head.weight.values).size());
  guard_ = ReturnGuard::New(delta_);
  held_out_guard_ = guard_;
  held_out_budget_.CountMembers(ContributionBudget::kProtectedMembers);
  Publish();
}

std::shared_ptr<const FleetHead::Snapshot> FleetHead::Read() const {
  absl::MutexLock lock(&snapshot_mutex_);
  return snapshot_;
}

FleetHead::Member::Member(std::shared_ptr<FleetHead> head, std::string contributor,
                          absl::string_view session_id)
    : head_(std::move(head)),
      contributor_(std::move(contributor)),
      held_out_(IsHeldOut(head_->held_out_key_, session_id)) {
  absl::MutexLock lock(&head_->mutex_);
  head_->budget_.Join(contributor_);
  if (held_out_) ++head_->held_out_sessions_;
}

FleetHead::Member::~Member() {
  absl::MutexLock lock(&head_->mutex_);
  head_->budget_.Leave(contributor_);
  if (held_out_) --head_->held_out_sessions_;
}

FleetHead::Merged FleetHead::Merge(const Eigen::VectorXf& contribution, double episode_return,
                                   const Source& source) {
  Merged merged;
  absl::MutexLock lock(&mutex_);
  if (source.members.has_value()) budget_.CountMembers(*source.members);
  const bool is_client = !source.contributor.empty();
  const bool held_out = source.held_out && budget_.is_protected();
  if (is_client && !budget_.Take(source.contributor, source.now)) {
    merged.outcome = UpdateOutcome::kOverBudget;
  } else {
    merged.outcome = Take(contribution, source, held_out);
    merged.rolled_back = Judge(episode_return, source, held_out);
  }
  ++(merged.outcome == UpdateOutcome::kApplied ? updates_ : rejected_);
  if (merged.rolled_back) {
    updates_ = 0;
    ++rollbacks_;
  }
  Publish();
  merged.snapshot = Read();
  return merged;
}

UpdateOutcome FleetHead::Take(const Eigen::VectorXf& contribution, const Source& source,
                              bool held_out) {
  SPIKESERVE_DCHECK_EQ(contribution.size(), delta_.size());
  Eigen::VectorXf clipped = Eigen::VectorXf::Zero(contribution.size());
  const UpdateBounds bounds = {.clip = options_.clip, .max_norm = options_.clip};
  const UpdateOutcome outcome = ApplyUpdate(1.0, contribution, bounds, &clipped);
  if (outcome != UpdateOutcome::kApplied) return outcome;
  if (!source.contributor.empty()) norms_.Add(source.contributor, FrobeniusNorm(clipped));
  if (held_out) return UpdateOutcome::kHeldOut;
  if (budget_.IsSuspended(source.contributor)) return UpdateOutcome::kOverBudget;
  if (guard_.on_probation) return UpdateOutcome::kHeldOut;
  if (guard_.has_reference || !budget_.is_protected()) return Add(contribution, source.contributor);
  gathered_.push_back({.contributor = source.contributor, .delta = std::move(clipped)});
  return UpdateOutcome::kApplied;
}

UpdateOutcome FleetHead::Add(const Eigen::VectorXf& contribution, const std::string& contributor) {
  UpdateBounds bounds = {.clip = options_.clip,
                         .max_norm = options_.max_drift * BaseNorm(*policy_)};
  if (budget_.is_protected()) {
    const double limit = norms_.Limit(contributor);
    if (std::min(FrobeniusNorm(contribution), bounds.clip) > limit) {
      bounds.clip = limit;
      ++trimmed_;
    }
  }
  return ApplyUpdate(1.0, contribution, bounds, &delta_);
}

bool FleetHead::Judge(double episode_return, const Source& source, bool held_out) {
  const double margin = options_.guard_margin;
  if (guard_.OnEpisode(episode_return, margin, &delta_)) {
    held_out_guard_.OnRestored(delta_);
    held_out_budget_.OnWindowEnd(/*bad=*/false);
    EndWindow(/*bad=*/true);
    return true;
  }
  if (guard_.returns.empty()) EndWindow(/*bad=*/false);
  if (!held_out || !held_out_budget_.Take(source.contributor, source.now)) return false;
  const bool bad = held_out_guard_.OnEpisode(episode_return, margin, &delta_);
  if (held_out_guard_.returns.empty()) held_out_budget_.OnWindowEnd(/*bad=*/false);
  if (!bad) return false;
  guard_.OnRestored(delta_);
  EndWindow(/*bad=*/true);
  return true;
}

void FleetHead::EndWindow(bool bad) {
  budget_.OnWindowEnd(bad);
  if (!bad) {
    for (const Gathered& each : gathered_) Add(each.delta, each.contributor);
  }
  gathered_.clear();
}

std::shared_ptr<const FleetHead::Snapshot> FleetHead::Rollback() {
  absl::MutexLock lock(&mutex_);
  std::shared_ptr<const Snapshot> before = Read();
  delta_.setZero();
  gathered_.clear();
  budget_.OnWindowEnd(/*bad=*/false);
  held_out_budget_.OnWindowEnd(/*bad=*/false);
  guard_ = ReturnGuard::New(delta_);
  held_out_guard_ = guard_;
  updates_ = 0;
  ++rollbacks_;
  Publish();
  return before;
}

std::vector<std::string> FleetHead::Members() const {
  absl::MutexLock lock(&mutex_);
  return budget_.Members();
}

int64_t FleetHead::HeldOutSessions() const {
  absl::MutexLock lock(&mutex_);
  return budget_.is_protected() ? held_out_sessions_ : 0;
}

FleetHead::State FleetHead::state() const {
  absl::MutexLock lock(&mutex_);
  return {.delta = delta_,
          .gathered = gathered_,
          .guard = guard_,
          .held_out_guard = held_out_guard_,
          .budget = budget_.state(),
          .held_out_budget = held_out_budget_.state(),
          .norms = norms_.state(),
          .updates = updates_,
          .rejected = rejected_,
          .trimmed = trimmed_,
          .rollbacks = rollbacks_};
}

void FleetHead::Restore(const State& state) {
  SPIKESERVE_DCHECK(IsPossible(state));
  absl::MutexLock lock(&mutex_);
  delta_ = state.delta;
  gathered_ = state.gathered;
  guard_ = state.guard;
  held_out_guard_ = state.held_out_guard;
  budget_.Restore(state.budget);
  held_out_budget_.Restore(state.held_out_budget);
  norms_.Restore(state.norms);
  updates_ = state.updates;
  rejected_ = state.rejected;
  trimmed_ = state.trimmed;
  rollbacks_ = state.rollbacks;
  Publish();
}

bool FleetHead::IsPossible(const State& state) const {
  const auto size = static_cast<Eigen::Index>(policy_->weights.head.weight.values.size());
  const auto is_guard = [size](const ReturnGuard& guard) {
    return guard.beginning.size() == size && guard.good.size() == size &&
           guard.returns.size() < ReturnGuard::kWindow;
  };
  const auto is_budget = [](const ContributionBudget::State& budget) {
    return budget.contributors.size() == budget.accounts.size();
  };
  return state.delta.size() == size && is_guard(state.guard) && is_guard(state.held_out_guard) &&
         is_budget(state.budget) && is_budget(state.held_out_budget) &&
         state.norms.contributors.size() == state.norms.norms.size() &&
         state.norms.norms.size() <= PeerNorms::kContributors &&
         state.gathered.size() < ReturnGuard::kWindow &&
         std::all_of(state.gathered.begin(), state.gathered.end(),
                     [size](const Gathered& each) { return each.delta.size() == size; });
}

void FleetHead::Publish() {
  auto next =
      std::make_shared<const Snapshot>(Snapshot{.head = HeadWith(*policy_, delta_),
                                                .delta = delta_,
                                                .drift = FrobeniusNorm(delta_) / BaseNorm(*policy_),
                                                .updates = updates_,
                                                .rejected = rejected_,
                                                .trimmed = trimmed_,
                                                .rollbacks = rollbacks_,
                                                .level = guard_.last});
  absl::MutexLock lock(&snapshot_mutex_);
  snapshot_.swap(next);  // the snapshot before is freed after the lock is released
}

}  // namespace spikeserve
