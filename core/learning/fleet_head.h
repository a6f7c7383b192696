// The action head that all fleet sessions of one policy version share.
//
// A session makes its decisions with immutable snapshots of the head. It collects the updates of an
// episode itself and hands over their sum when the episode ends. A decision therefore copies one
// pointer and does not wait for a merge, and a merge is one addition:
//   W <- W + dW,   |dW| <= FleetOptions::clip,   |W - W_base| <= max_drift |W_base|
// The order of the contributions changes each weight by at most kMergeTolerance, as long as neither
// the limit of the drift nor the guard intervenes.
//
// A ContributionBudget bounds what one contributor can do. While a head with enough members to be
// protected has no reference, its contributions are gathered and added at the end of the first
// window, so that the reference is that of the policy's own head.
//
// Equal sequences of Merge() and Rollback() leave heads that are equal bit for bit, in whichever
// processes they run, if all of them pass the number of members.
//
// Thread-safe.
#ifndef CORE_LEARNING_FLEET_HEAD_H_
#define CORE_LEARNING_FLEET_HEAD_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "Eigen/Core"
#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/learning/contribution_budget.h"
#include "core/learning/head_update.h"
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

  // The head at one point in time; immutable.
  struct Snapshot {
    Linear head;            // W_base + delta, and the bias of the policy
    Eigen::VectorXf delta;  // [act * d], row-major: W - W_base
    double drift = 0.0;     // |W - W_base| / |W_base|
    int64_t updates = 0;    // contributions merged since the last rollback
    int64_t rejected = 0;   // contributions refused since the head was created, for any reason
    int64_t rollbacks = 0;  // by the guard or an operator, since the head was created
    WindowLevel level;      // of the last window of episodes; see return_guard.h
  };

  // Starts as the head of `policy`, which is shared and not copied.
  explicit FleetHead(std::shared_ptr<const Policy> policy, FleetOptions options = {});

  // Returns the current snapshot. Does not wait for a merge.
  std::shared_ptr<const Snapshot> Read() const;

  struct Merged {
    UpdateOutcome outcome = UpdateOutcome::kApplied;
    bool rolled_back = false;                  // the guard restored an earlier head
    std::shared_ptr<const Snapshot> snapshot;  // after the merge
  };
  // Adds the contribution [act * d] of one episode and passes the return of that episode to the
  // guard, unless `contributor` has used up its budget. `now` is the time of a monotonic clock, the
  // same clock in every call. `members` is the number of contributors with a session in all
  // processes that share the head; absent: that of the Members of this one.
  Merged Merge(const Eigen::VectorXf& contribution, double episode_return,
               const std::string& contributor = "", absl::Duration now = absl::ZeroDuration(),
               std::optional<size_t> members = std::nullopt);

  // Returns contributors with a Member; see ContributionBudget::Members().
  std::vector<std::string> Members() const;

  // All that decides about the head and its later changes.
  struct State {
    Eigen::VectorXf delta;     // [act * d]
    Eigen::VectorXf gathered;  // [act * d]
    ReturnGuard guard;
    ContributionBudget::State budget;
    int64_t updates = 0;
    int64_t rejected = 0;
    int64_t rollbacks = 0;
  };
  State state() const;
  // Goes on from `state`. REQUIRES: IsPossible(state).
  void Restore(const State& state);
  // Returns true if `state` may be that of a head of this policy.
  bool IsPossible(const State& state) const;

  // A session that decides with the head; protects the others by its presence (ContributionBudget).
  class Member {
   public:
    Member(std::shared_ptr<FleetHead> head, std::string contributor);
    ~Member();
    Member(const Member&) = delete;
    Member& operator=(const Member&) = delete;

    FleetHead& head() const { return *head_; }
    const std::string& contributor() const { return contributor_; }

   private:
    const std::shared_ptr<FleetHead> head_;
    const std::string contributor_;
  };

  // Restores the head of the policy bit for bit and starts a new guard. Returns the snapshot before
  // the rollback.
  std::shared_ptr<const Snapshot> Rollback();

 private:
  // Returns how a contribution that is within the budget was added.
  UpdateOutcome Add(const Eigen::VectorXf& contribution) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // Starts a new window of the budget and adds what was gathered. `bad`: the guard has restored an
  // earlier head.
  void EndWindow(bool bad) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // Makes a snapshot of the members and lets Read return it.
  void Publish() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::shared_ptr<const Policy> policy_;
  const FleetOptions options_;

  mutable absl::Mutex mutex_;  // held for a whole merge
  Eigen::VectorXf delta_ ABSL_GUARDED_BY(mutex_);
  Eigen::VectorXf gathered_ ABSL_GUARDED_BY(mutex_);  // [act * d]: to add after the first window
  ReturnGuard guard_ ABSL_GUARDED_BY(mutex_);
  ContributionBudget budget_ ABSL_GUARDED_BY(mutex_);
  int64_t updates_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t rejected_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t rollbacks_ ABSL_GUARDED_BY(mutex_) = 0;

  mutable absl::Mutex snapshot_mutex_ ABSL_ACQUIRED_AFTER(mutex_);  // held only to copy a pointer
  std::shared_ptr<const Snapshot> snapshot_ ABSL_GUARDED_BY(snapshot_mutex_);
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_FLEET_HEAD_H_
