// The action head that all fleet sessions of one policy version share.
//
// A session makes its decisions with immutable snapshots of the head. It collects the updates of an
// episode itself and hands over their sum when the episode ends. A decision therefore copies one
// pointer and does not wait for a merge, and a merge is one addition:
//   W <- W + dW,   |dW| <= FleetOptions::clip,   |W - W_base| <= max_drift |W_base|
// The order of the contributions changes each weight by at most kMergeTolerance, as long as neither
// the limit of the drift nor the guard intervenes.
//
// Thread-safe.
#ifndef CORE_LEARNING_FLEET_HEAD_H_
#define CORE_LEARNING_FLEET_HEAD_H_

#include <cstdint>
#include <memory>

#include "Eigen/Core"
#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
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
    int64_t rejected = 0;   // contributions refused since the head was created
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
  // guard.
  Merged Merge(const Eigen::VectorXf& contribution, double episode_return);

  // Restores the head of the policy bit for bit and starts a new guard. Returns the snapshot before
  // the rollback.
  std::shared_ptr<const Snapshot> Rollback();

 private:
  // Makes a snapshot of the members and lets Read return it.
  void Publish() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::shared_ptr<const Policy> policy_;
  const FleetOptions options_;

  mutable absl::Mutex mutex_;  // held for a whole merge
  Eigen::VectorXf delta_ ABSL_GUARDED_BY(mutex_);
  ReturnGuard guard_ ABSL_GUARDED_BY(mutex_);
  int64_t updates_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t rejected_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t rollbacks_ ABSL_GUARDED_BY(mutex_) = 0;

  mutable absl::Mutex snapshot_mutex_ ABSL_ACQUIRED_AFTER(mutex_);  // held only to copy a pointer
  std::shared_ptr<const Snapshot> snapshot_ ABSL_GUARDED_BY(snapshot_mutex_);
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_FLEET_HEAD_H_
