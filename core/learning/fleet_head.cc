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
  state_.delta.setZero(AsVector(policy_->weights.head.weight.values).size());
  state_.guard = ReturnGuard::New(state_.delta);
  state_.held_out_guard = state_.guard;
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
  ++head_->members_[contributor_];
  if (held_out_) ++head_->held_out_sessions_;
}

FleetHead::Member::~Member() {
  absl::MutexLock lock(&head_->mutex_);
  const auto member = head_->members_.find(contributor_);
  if (--member->second == 0) head_->members_.erase(member);
  if (held_out_) --head_->held_out_sessions_;
}

MergeOutcome FleetHead::Merge(const Contribution& contribution, absl::Duration now,
                              std::optional<size_t> members) {
  absl::MutexLock lock(&mutex_);
  if (members.has_value()) counted_ = members;
  now = absl::Trunc(now, absl::Milliseconds(1));  // as it is kept
  Keep(contribution, now);
  MergeOutcome outcome = Fold(contribution, now);
  Publish();
  outcome.drift = Read()->drift;
  outcome.watched_return = state_.guard.last.mean;
  return outcome;
}

MergeOutcome FleetHead::Fold(const Contribution& contribution, absl::Duration now) {
  MergeOutcome outcome;
  const std::string& contributor = contribution.contributor;
  const bool held_out = contribution.held_out && is_protected();
  if (!contributor.empty() && !state_.budget.Take(contributor, now, is_protected())) {
    outcome.update = UpdateOutcome::kOverBudget;
  } else {
    outcome.update = Take(contribution, held_out);
    outcome.rolled_back = Judge(contribution, now, held_out);
  }
  ++(outcome.update == UpdateOutcome::kApplied ? state_.updates : state_.rejected);
  if (outcome.rolled_back) {
    state_.updates = 0;
    ++state_.rollbacks;
  }
  return outcome;
}

void FleetHead::FoldInto(State* state, const Kept& kept) {
  const auto counted = std::exchange(counted_, static_cast<size_t>(kept.members));
  std::swap(state_, *state);
  Fold(kept.contribution, absl::Milliseconds(kept.time_ms));
  std::swap(state_, *state);
  counted_ = counted;
}

void FleetHead::Keep(const Contribution& contribution, absl::Duration now) {
  auto& [base, kept, forgotten_ms] = past_;
  const int64_t time_ms = absl::ToInt64Milliseconds(now);
  const int64_t oldest_ms = time_ms - absl::ToInt64Milliseconds(kKept);
  const auto most = std::max<size_t>(
      1, kMostKeptNumbers / std::max<size_t>(1, static_cast<size_t>(contribution.delta.size())));
  // The base goes on to the next contribution of an operator.
  while (!kept.empty() && (kept.front().contribution.operators.empty() || kept.size() >= most ||
                           kept.front().time_ms < oldest_ms)) {
    if (!kept.front().contribution.operators.empty()) forgotten_ms = kept.front().time_ms;
    FoldInto(&base, kept.front());
    kept.pop_front();
  }
  if (kept.empty()) {
    if (contribution.operators.empty()) return;
    base = state_;
  }
  kept.push_back({contribution, time_ms, static_cast<int64_t>(members())});
}

MergeOutcome FleetHead::Undo(const std::string& operator_id, absl::Duration ago,
                             absl::Duration now) {
  absl::MutexLock lock(&mutex_);
  MergeOutcome outcome = {.drift = Read()->drift, .watched_return = state_.guard.last.mean};
  const int64_t since_ms = absl::ToInt64Milliseconds(now - ago);
  if (past_.forgotten_ms != 0 && past_.forgotten_ms >= since_ms) {
    outcome.undone = -1;
    return outcome;
  }
  outcome.undone = static_cast<int64_t>(std::erase_if(past_.kept, [&](const Kept& kept) {
    const auto& operators = kept.contribution.operators;
    return kept.time_ms >= since_ms &&
           std::find(operators.begin(), operators.end(), operator_id) != operators.end();
  }));
  if (outcome.undone == 0) return outcome;
  State state = past_.base;
  for (const Kept& kept : past_.kept) FoldInto(&state, kept);
  state_ = std::move(state);
  Publish();
  outcome.drift = Read()->drift;
  outcome.watched_return = state_.guard.last.mean;
  return outcome;
}

UpdateOutcome FleetHead::Take(const Contribution& contribution, bool held_out) {
  const Eigen::VectorXf& delta = contribution.delta;
  const std::string& contributor = contribution.contributor;
  SPIKESERVE_DCHECK_EQ(delta.size(), state_.delta.size());
  Eigen::VectorXf clipped = Eigen::VectorXf::Zero(delta.size());
  const UpdateBounds bounds = {.clip = options_.clip, .max_norm = options_.clip};
  const UpdateOutcome outcome = ApplyUpdate(1.0, delta, bounds, &clipped);
  if (outcome != UpdateOutcome::kApplied) return outcome;
  const double norm = FrobeniusNorm(clipped);
  if (!contributor.empty() && norm > 0.0) state_.norms.Add(contributor, norm);
  if (held_out) return UpdateOutcome::kHeldOut;
  if (state_.budget.IsSuspended(contributor)) return UpdateOutcome::kOverBudget;
  if (state_.guard.on_probation) return UpdateOutcome::kHeldOut;
  if (state_.guard.has_reference || !is_protected()) return Add(delta, contributor);
  state_.gathered.push_back({.contributor = contributor, .delta = std::move(clipped)});
  return UpdateOutcome::kApplied;
}

UpdateOutcome FleetHead::Add(const Eigen::VectorXf& delta, const std::string& contributor) {
  UpdateBounds bounds = {.clip = options_.clip,
                         .max_norm = options_.max_drift * BaseNorm(*policy_)};
  if (is_protected()) {
    const double limit = state_.norms.Limit(contributor);
    if (std::min(FrobeniusNorm(delta), bounds.clip) > limit) {
      bounds.clip = limit;
      ++state_.trimmed;
    }
  }
  return ApplyUpdate(1.0, delta, bounds, &state_.delta);
}

bool FleetHead::Judge(const Contribution& contribution, absl::Duration now, bool held_out) {
  if (!contribution.operators.empty()) return false;
  const double margin = options_.guard_margin;
  if (state_.guard.OnEpisode(contribution.episode_return, margin, &state_.delta)) {
    state_.held_out_guard.OnRestored(state_.delta);
    state_.held_out_budget.OnWindowEnd(/*bad=*/false, /*is_protected=*/true);
    EndWindow(/*bad=*/true);
    return true;
  }
  if (state_.guard.returns.empty()) EndWindow(/*bad=*/false);
  if (!held_out ||
      !state_.held_out_budget.Take(contribution.contributor, now, /*is_protected=*/true)) {
    return false;
  }
  const bool bad =
      state_.held_out_guard.OnEpisode(contribution.episode_return, margin, &state_.delta);
  if (state_.held_out_guard.returns.empty()) {
    state_.held_out_budget.OnWindowEnd(/*bad=*/false, /*is_protected=*/true);
  }
  if (!bad) return false;
  state_.guard.OnRestored(state_.delta);
  EndWindow(/*bad=*/true);
  return true;
}

void FleetHead::EndWindow(bool bad) {
  state_.budget.OnWindowEnd(bad, is_protected());
  if (!bad) {
    for (const Gathered& each : state_.gathered) Add(each.delta, each.contributor);
  }
  state_.gathered.clear();
}

std::shared_ptr<const FleetHead::Snapshot> FleetHead::Rollback() {
  absl::MutexLock lock(&mutex_);
  std::shared_ptr<const Snapshot> before = Read();
  past_ = {};
  state_.delta.setZero();
  state_.gathered.clear();
  state_.budget.OnWindowEnd(/*bad=*/false, is_protected());
  state_.held_out_budget.OnWindowEnd(/*bad=*/false, /*is_protected=*/true);
  state_.guard = ReturnGuard::New(state_.delta);
  state_.held_out_guard = state_.guard;
  state_.updates = 0;
  ++state_.rollbacks;
  Publish();
  return before;
}

std::vector<std::string> FleetHead::Members() const {
  absl::MutexLock lock(&mutex_);
  std::vector<std::string> members;
  for (const auto& [contributor, sessions] : members_) {
    if (members.size() < ContributionBudget::kProtectedMembers) members.push_back(contributor);
  }
  return members;
}

int64_t FleetHead::HeldOutSessions() const {
  absl::MutexLock lock(&mutex_);
  return is_protected() ? held_out_sessions_ : 0;
}

FleetHead::State FleetHead::state() const {
  absl::MutexLock lock(&mutex_);
  State state = state_;
  const bool has_past = !past_.kept.empty() || past_.forgotten_ms != 0;
  if (has_past) state.past = std::make_shared<const Past>(past_);
  return state;
}

void FleetHead::Restore(const State& state) {
  SPIKESERVE_DCHECK(IsPossible(state));
  absl::MutexLock lock(&mutex_);
  state_ = state;
  const auto past = std::exchange(state_.past, nullptr);
  past_ = past == nullptr ? Past() : *past;
  Publish();
}

bool FleetHead::IsPossible(const State& state) const {
  const auto size = static_cast<Eigen::Index>(policy_->weights.head.weight.values.size());
  const auto is_guard = [size](const ReturnGuard& guard) {
    return guard.beginning.size() == size && guard.good.size() == size &&
           guard.returns.size() < ReturnGuard::kWindow;
  };
  const auto is_budget = [](const ContributionBudget& budget) {
    return budget.contributors.size() == budget.accounts.size() &&
           std::is_sorted(budget.contributors.begin(), budget.contributors.end());
  };
  const auto is_past = [&](const Past& past) {
    return (past.kept.empty() || IsPossible(past.base)) &&
           std::all_of(past.kept.begin(), past.kept.end(),
                       [size](const Kept& kept) { return kept.contribution.delta.size() == size; });
  };
  return (state.past == nullptr || is_past(*state.past)) && state.delta.size() == size &&
         is_guard(state.guard) && is_guard(state.held_out_guard) && is_budget(state.budget) &&
         is_budget(state.held_out_budget) &&
         state.norms.contributors.size() == state.norms.norms.size() &&
         state.norms.norms.size() <= PeerNorms::kContributors &&
         state.gathered.size() < ReturnGuard::kWindow &&
         std::all_of(state.gathered.begin(), state.gathered.end(),
                     [size](const Gathered& each) { return each.delta.size() == size; });
}

void FleetHead::Publish() {
  auto next = std::make_shared<const Snapshot>(
      Snapshot{.head = HeadWith(*policy_, state_.delta),
               .delta = state_.delta,
               .drift = FrobeniusNorm(state_.delta) / BaseNorm(*policy_),
               .updates = state_.updates,
               .rejected = state_.rejected,
               .trimmed = state_.trimmed,
               .rollbacks = state_.rollbacks,
               .level = state_.guard.last});
  absl::MutexLock lock(&snapshot_mutex_);
  snapshot_.swap(next);  // the snapshot before is freed after the lock is released
}

}  // namespace spikeserve
