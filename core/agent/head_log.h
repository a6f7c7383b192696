// Defines how the sessions of several servers learn shared heads together: each version of a policy
// has an ordered log, to which a session appends what an episode contributes. Every server folds
// the entries of the log into its heads in their order, so the heads of all servers are equal.
//
//   auto fleet = std::make_shared<FleetContribution>(served, contribution);
//   fleet->Append();  // once the store has the session with `contribution`
//   fleet->WhenMerged([](const absl::Status& status) { ... });
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/learning/contribution.h"
#include "core/learning/tenant_heads.h"

namespace spikeserve {

class FleetContribution;
struct ServedPolicy;

// The log of the heads of one policy version. Implementations are thread-safe.
class HeadLog {
 public:
  virtual ~HeadLog() = default;

  // Returns the heads that the log changes, and nothing else.
  virtual std::shared_ptr<TenantHeads> heads() const = 0;

  // Adds the contribution to the log unless the log has it, and returns at once. Calls its
  // OnOutcome() on another thread when the heads of this process have taken the entry, and whenever
  // the log cannot be reached; then tries again.
  virtual void Append(std::shared_ptr<FleetContribution> contribution) = 0;

  // The methods below block until the heads of this process have taken all that the log has, with
  // the entry that they add. UNAVAILABLE if the log cannot be reached; the entry may still be made.

  virtual absl::Status CatchUp() = 0;
  // Restores the policy's head of a tenant. Returns the drift before.
  virtual absl::StatusOr<double> Rollback(const std::string& tenant) = 0;
  // As FleetHead::Undo(), of the head of a tenant.
  virtual absl::StatusOr<MergeOutcome> Undo(const std::string& tenant,
                                            const std::string& operator_id, absl::Duration ago) = 0;
  // Pauses or resumes the merges of all heads.
  virtual absl::Status SetPaused(bool paused) = 0;
};

// Opens the log of a policy version, which has all members except its heads and its log. Versions
// of equal name, number and file share one. Thread-safe.
using OpenHeadLog = std::function<std::shared_ptr<HeadLog>(const ServedPolicy& served)>;

// The contribution of one episode on its way into the log. Thread-safe.
class FleetContribution : public std::enable_shared_from_this<FleetContribution> {
 public:
  using Done = std::function<void(const absl::Status&)>;

  FleetContribution(std::shared_ptr<const ServedPolicy> served, Contribution value)
      : served_(std::move(served)), value_(std::move(value)) {}

  const Contribution& value() const { return value_; }

  // Hands it to the log of its policy. Further calls do nothing.
  void Append() ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns the summary of the episode with the outcome of the merge, once it is known.
  std::optional<LearningSummary> merged() const ABSL_LOCKS_EXCLUDED(mutex_);

  // Calls `done` once, on any thread: with OK when the outcome is known, and with an error if the
  // log cannot be reached. The contribution is merged later even then.
  void WhenMerged(Done done) ABSL_LOCKS_EXCLUDED(mutex_);

  // Called by the log. `is_new`: this process has made the entry, so that it reports the outcome to
  // the observer of the policy.
  void OnOutcome(const absl::StatusOr<MergeOutcome>& outcome, bool is_new)
      ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  const std::shared_ptr<const ServedPolicy> served_;
  const Contribution value_;

  mutable absl::Mutex mutex_;
  bool appended_ ABSL_GUARDED_BY(mutex_) = false;
  std::optional<LearningSummary> merged_ ABSL_GUARDED_BY(mutex_);
  std::vector<Done> waiters_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
