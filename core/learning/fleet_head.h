// The action head that all fleet sessions of one policy version share.
//
// A session makes its decisions with immutable snapshots of the head. It collects the updates of an
// episode itself and hands over their sum when the episode ends. A decision therefore copies one
// pointer and does not wait for a merge, and a merge is one addition:
//   W <- W + dW,   |dW| <= FleetOptions::clip,   |W - W_base| <= max_drift |W_base|
// The order of the contributions changes each weight by at most kMergeTolerance, as long as none of
// them is shortened and neither the limit of the drift nor a guard intervenes.
//
// A ContributionBudget bounds what one contributor can do. A head with enough members is protected:
// - A contribution that is much longer than those of the others is shortened (PeerNorms).
// - While the head has no reference, contributions are gathered and added at the end of the first
//   window, so that the reference is that of the policy's own head.
// - Sessions that are held out contribute nothing (held_out.h). A second guard judges by their
//   returns alone, which those who contribute cannot invent. The first guard judges by all returns
//   and therefore decides sooner. After a rollback by one of them both start a new window, and no
//   session contributes in the next one of the first guard, which measures the restored head.
//
// A contribution of an episode in which an operator acted is kept for a while, and so is all that
// was merged since: Undo() merges the rest again, as if the operator's had never come.
//
// Equal sequences of Merge(), Undo() and Rollback() leave heads that are equal bit for bit, in
// whichever processes they run, if all of them pass the time and the number of members.
//
// Thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "Eigen/Core"
#include "absl/base/thread_annotations.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/learning/contribution.h"
#include "core/learning/contribution_budget.h"
#include "core/learning/head_update.h"
#include "core/learning/held_out.h"
#include "core/learning/peer_norms.h"
#include "core/learning/return_guard.h"
#include "core/model/policy.h"
#include "core/model/weights.h"

namespace spikeserve {

// Limits of the shared head. A session cannot change them.
struct FleetOptions {
  double clip = 0.5;           // largest Frobenius norm of the contribution of one episode
  double max_drift = 2.0;      // largest |W - W_base| / |W_base|
  double guard_margin = 0.02;  // see return_guard.h
};

class FleetHead {
 public:
  // Largest difference of a weight between two orders of the same contributions, which comes from
  // the rounding of float additions; for up to a thousand contributions between rollbacks.
  static constexpr double kMergeTolerance = 1e-5;
  // For how long an operator's contribution can be undone, and of how many numbers the
  // contributions since may be: 1,024 of a head of 256.
  static constexpr absl::Duration kKept = absl::Minutes(10);
  static constexpr size_t kMostKeptNumbers = size_t{1} << 18;

  // The head at one point in time; immutable.
  struct Snapshot {
    Linear head;            // W_base + delta, and the bias of the policy
    Eigen::VectorXf delta;  // [act * d], row-major: W - W_base
    double drift = 0.0;     // |W - W_base| / |W_base|
    int64_t updates = 0;    // contributions merged since the last rollback
    int64_t rejected = 0;   // contributions refused since the head was created, for any reason
    int64_t trimmed = 0;    // contributions shortened since the head was created
    int64_t rollbacks = 0;  // by a guard or an operator, since the head was created
    WindowLevel level;      // of the last window of all returns; see return_guard.h
  };

  // Starts as the head of `policy`, which is shared and not copied. The key decides which sessions
  // are held out; clients must not know it.
  explicit FleetHead(std::shared_ptr<const Policy> policy, FleetOptions options = {},
                     const HeldOutKey& held_out_key = RandomHeldOutKey());

  // Returns the current snapshot. Does not wait for a merge.
  std::shared_ptr<const Snapshot> Read() const;

  // Adds the contribution of an episode and passes its return to the guards, unless the contributor
  // has used up its budget. `now` is the time of a monotonic clock, the same in every call;
  // `members` counts the contributors with a session in all processes that share the head (absent:
  // the Members of this one).
  MergeOutcome Merge(const Contribution& contribution, absl::Duration now,
                     std::optional<size_t> members = std::nullopt);

  // Makes the head the one that all contributions make except those of the last `ago` in which
  // `operator_id` acted. Sets `undone` and `drift` of the outcome. `now` as Merge().
  MergeOutcome Undo(const std::string& operator_id, absl::Duration ago, absl::Duration now);

  // Returns contributors with a Member, at most kProtectedMembers: more make no difference.
  std::vector<std::string> Members() const;
  // Returns how many sessions of this process are held out: 0 while the head is not protected.
  int64_t HeldOutSessions() const;

  // A contribution that waits for the end of the first window.
  struct Gathered {
    std::string contributor;
    Eigen::VectorXf delta;  // [act * d]
  };

  // All that decides about the head and its later changes.
  struct Past;
  struct State {
    Eigen::VectorXf delta;  // [act * d]
    std::vector<Gathered> gathered;
    ReturnGuard guard;           // of all returns
    ReturnGuard held_out_guard;  // of the returns of sessions that are held out
    ContributionBudget budget;
    ContributionBudget held_out_budget;  // always protected
    PeerNorms norms;
    int64_t updates = 0;
    int64_t rejected = 0;
    int64_t trimmed = 0;
    int64_t rollbacks = 0;
    std::shared_ptr<const Past> past;  // null: nothing to undo, and nothing was forgotten
  };
  // What was merged, with the time and the members.
  struct Kept {
    Contribution contribution;
    int64_t time_ms = 0;
    int64_t members = 0;
  };
  struct Past {
    State base;                // before the first of `kept`
    std::deque<Kept> kept;     // oldest first, which is an operator's
    int64_t forgotten_ms = 0;  // when the last operator's came that can be undone no more; 0: none
  };
  State state() const;
  // Continues from `state`. REQUIRES: IsPossible(state).
  void Restore(const State& state);
  // Returns true if `state` may be that of a head of this policy.
  bool IsPossible(const State& state) const;

  // A session that decides with the head; protects the others by its presence (ContributionBudget).
  class Member {
   public:
    Member(std::shared_ptr<FleetHead> head, std::string contributor, absl::string_view session_id);
    ~Member();
    Member(const Member&) = delete;
    Member& operator=(const Member&) = delete;

    FleetHead& head() const { return *head_; }
    const std::string& contributor() const { return contributor_; }
    bool held_out() const { return held_out_; }

   private:
    const std::shared_ptr<FleetHead> head_;
    const std::string contributor_;
    const bool held_out_;
  };

  // Restores the head of the policy bit for bit and starts new guards. Returns the snapshot before
  // the rollback.
  std::shared_ptr<const Snapshot> Rollback();

 private:
  size_t members() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return counted_.value_or(members_.size());
  }
  bool is_protected() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return members() >= ContributionBudget::kProtectedMembers;
  }
  // Does what Merge() does to the state. Sets `update` and `rolled_back` of the outcome.
  MergeOutcome Fold(const Contribution& contribution, absl::Duration now)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Does it for a contribution that was kept, to `state`.
  void FoldInto(State* state, const Kept& kept) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Keeps a contribution that is about to be merged, and forgets what is too old, or too much.
  void Keep(const Contribution& contribution, absl::Duration now)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Takes a contribution that is within the budget. Returns its outcome.
  UpdateOutcome Take(const Contribution& contribution, bool held_out)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Adds a contribution to the head, shortened if the head is protected.
  UpdateOutcome Add(const Eigen::VectorXf& delta, const std::string& contributor)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Passes a return to the guards. Returns true if one of them restored an earlier head.
  bool Judge(const Contribution& contribution, absl::Duration now, bool held_out)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Starts a new window of the budget and adds what was gathered. `bad`: a guard has restored an
  // earlier head.
  void EndWindow(bool bad) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // Makes a snapshot of the members and lets Read return it.
  void Publish() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::shared_ptr<const Policy> policy_;
  const FleetOptions options_;
  const HeldOutKey held_out_key_;

  mutable absl::Mutex mutex_;            // held for a whole merge
  State state_ ABSL_GUARDED_BY(mutex_);  // without `past`
  Past past_ ABSL_GUARDED_BY(mutex_);
  std::map<std::string, int> members_ ABSL_GUARDED_BY(mutex_);  // open sessions by contributor
  std::optional<size_t> counted_ ABSL_GUARDED_BY(mutex_);       // members in all processes
  int64_t held_out_sessions_ ABSL_GUARDED_BY(mutex_) = 0;       // Members

  mutable absl::Mutex snapshot_mutex_ ABSL_ACQUIRED_AFTER(mutex_);  // held only to copy a pointer
  std::shared_ptr<const Snapshot> snapshot_ ABSL_GUARDED_BY(snapshot_mutex_);
};

}  // namespace spikeserve
