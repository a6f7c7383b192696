// The action head that all fleet sessions of one policy version share.
//
// A session plays on snapshots of the head, gathers what an episode taught it by itself, and hands
// that over once, when the episode has ended. So a decision takes a pointer and waits for no merge,
// and a merge is one addition:
//   W <- W + dW,   |dW| <= FleetOptions::clip,   |W - W_base| <= max_drift |W_base|
// Contributions handed over in any order leave the same head, each weight within kMergeTolerance,
// as long as neither the bound on drift nor the guard steps in.
//
// Thread-safe.
#ifndef CORE_LEARNING_FLEET_HEAD_H_
#define CORE_LEARNING_FLEET_HEAD_H_

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "core/learning/head_update.h"
#include "core/learning/return_guard.h"
#include "core/model/policy.h"
#include "core/model/weights.h"

namespace spikeserve {

// Bounds no session can move.
struct FleetOptions {
  double clip = 0.5;       // longest contribution of one episode, in Frobenius norm
  double max_drift = 2.0;  // largest |W - W_base| / |W_base|
  double guard_margin = 0.02;
};

class FleetHead {
 public:
  // Of float additions in another order, for up to a thousand contributions between rollbacks.
  static constexpr double kMergeTolerance = 1e-5;

  // The head at one moment; immutable.
  struct Snapshot {
    Linear head;               // W_base + delta, and the policy's bias
    std::vector<float> delta;  // [act, d]: W - W_base
    double drift = 0.0;        // |W - W_base| / |W_base|
    int64_t updates = 0;       // contributions taken in since the last rollback
    int64_t rejected = 0;      // contributions refused, ever
    int64_t rollbacks = 0;     // by the guard or by an operator, ever
    WindowLevel level;         // what the last window of episodes earned; see return_guard.h
  };

  // `policy` is shared, not copied.
  explicit FleetHead(std::shared_ptr<const Policy> policy, FleetOptions options = {});

  std::shared_ptr<const Snapshot> Read() const;

  struct Merged {
    UpdateOutcome outcome = UpdateOutcome::kApplied;
    bool rolled_back = false;                  // the guard put back the last good head
    std::shared_ptr<const Snapshot> snapshot;  // after it
  };
  // One episode's contribution [act, d], and the return it was played for.
  Merged Merge(const std::vector<float>& contribution, double episode_return);

  // Puts the policy's own head back, bit for bit; the guard begins anew. Returns the snapshot
  // before.
  std::shared_ptr<const Snapshot> Rollback();

 private:
  void Publish() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::shared_ptr<const Policy> policy_;
  const FleetOptions options_;

  mutable absl::Mutex mutex_;  // of a merge
  std::vector<float> delta_ ABSL_GUARDED_BY(mutex_);
  ReturnGuard guard_ ABSL_GUARDED_BY(mutex_);
  int64_t updates_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t rejected_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t rollbacks_ ABSL_GUARDED_BY(mutex_) = 0;

  mutable absl::Mutex snapshot_mutex_ ABSL_ACQUIRED_AFTER(mutex_);  // held to copy a pointer
  std::shared_ptr<const Snapshot> snapshot_ ABSL_GUARDED_BY(snapshot_mutex_);
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_FLEET_HEAD_H_
