// Runs the roll-outs: moves the sessions of a policy step by step to a new version, compares it
// with the stable version, and ends the roll-out if the new version is worse.
//
//   RolloutManager rollouts(registry, metrics, &clock, [](const RolloutManager::Change& change)
//   {}); auto status = rollouts.Start("cartpole", {.version = 2, .steps = {1, 10, 50, 100}});
//   rollouts.Tick();  // about five times a second
//
// The settings of the policy hold the state, so a restarted server goes on where the last one was.
// Time counts towards a step only while a server is running. Thread-safe.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/base/live_servers.h"
#include "server/metrics/metrics.h"
#include "server/policies/policy_registry.h"
#include "server/policies/rollout.h"

namespace spikeserve {

class RolloutManager {
 public:
  // A change that the manager made by itself.
  struct Change {
    std::string action;  // AdvanceRollout, ReturnRollout, CompleteRollout or AbortRollout
    std::string policy;
    std::string reason;
    std::shared_ptr<const PolicyCatalog> before;
    std::shared_ptr<const PolicyCatalog> after;
  };

  using Check = std::function<absl::Status(const ServedPolicy& stable, const ServedPolicy& fresh)>;

  // A roll-out with its evidence of this moment.
  struct Progress {
    Rollout rollout;
    VersionEvidence::Counts new_version;
    VersionEvidence::Counts stable_version;
  };

  // Resumes the roll-outs that the settings say are running. `registry`, `metrics` and `clock` must
  // outlive the manager, as must `replicas`. `changed` is called by Tick. Of several servers that
  // share their settings, one judges a roll-out, by its own sessions; if it dies, another goes on.
  RolloutManager(PolicyRegistry* registry, Metrics* metrics, const Clock* clock,
                 const LiveServers* replicas, std::function<void(const Change&)> changed);

  // Starts a roll-out. `plan` has the version, the steps, the hold time, the fewest episodes, the
  // conditions and the offline evaluation; its other fields are ignored. Returns the errors that
  // policy_admin.proto names for StartRollout, and that of `check`.
  absl::Status Start(const std::string& policy, Rollout plan, const Check& check = nullptr);

  // Ends a running roll-out for an operator. Returns NOT_FOUND if the policy is not served and
  // FAILED_PRECONDITION if no roll-out of it is running.
  absl::Status Cancel(const std::string& policy);

  // Returns the last roll-out of every served policy that had one.
  std::map<std::string, Progress> List() const;

  // Saves the evidence of all running roll-outs. To be called when the server stops.
  void SaveEvidence();

  // Judges every running roll-out, and advances, completes or aborts it.
  void Tick();

 private:
  // State that is newer than the settings, which are not written at every tick.
  struct Running {
    absl::Duration ticked;  // time of the clock
    absl::Duration saved;
    int64_t step = 0;  // that is held
    double held_seconds = 0.0;
    std::string disputed = "";  // as Rollout::disputed
    // When it was disputed without a contradiction; time of the clock.
    std::optional<absl::Duration> uncontradicted_since = std::nullopt;
  };

  // `served` has both versions of the roll-out that are served.
  void Watch(const std::string& policy, const CatalogPolicy& served, const Rollout& rollout);
  void Stop(const std::string& policy, const Rollout& rollout);
  Progress ProgressOf(const std::string& policy, const Rollout& rollout) const
      ABSL_SHARED_LOCKS_REQUIRED(mutex_);
  // Begins to judge a roll-out, with the evidence that its last judge has saved.
  void TakeOver(const std::string& policy, const CatalogPolicy& served)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void TickOne(const std::string& policy, const CatalogPolicy& catalog_policy)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Returns why a running roll-out has to be aborted, or an empty string. Updates what its Running
  // says of a dispute.
  std::string FindAbort(const std::string& policy, const CatalogPolicy& served,
                        const Progress& progress) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Returns whether the step was held long enough, with enough evidence to leave it.
  bool MayAdvance(const std::string& policy, const Progress& progress) const
      ABSL_SHARED_LOCKS_REQUIRED(mutex_);
  // Leaves a step that was held long enough.
  void Advance(const std::string& policy, const Progress& progress)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Goes back to the first step: while it is in doubt whether the version is worse, the stable
  // version serves.
  void GoBack(const std::string& policy, const Progress& progress)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  absl::Status EnterStep(const std::string& policy, const Progress& progress, int64_t step)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Begins to hold the step of the settings, unless it is held: also one that a store has taken
  // without an answer.
  void HoldStep(const std::string& policy, int64_t version, int64_t step)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Ends a running roll-out and gives all sessions to the default version.
  absl::Status End(const std::string& policy, RolloutState state, const std::string& reason)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Changes the settings of a running roll-out, with the evidence of now.
  absl::Status Save(const std::string& policy,
                    absl::FunctionRef<void(Rollout*, PolicySettings*)> change)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void SaveOrLog(const std::string& policy) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // As Save, for a change of the manager itself: reports it, or logs why it failed.
  void SaveAndReport(const std::string& action, const std::string& policy,
                     const std::string& reason, absl::FunctionRef<absl::Status()> save);

  PolicyRegistry* const registry_;
  Metrics* const metrics_;
  const Clock* const clock_;
  const LiveServers* const replicas_;
  const std::function<void(const Change&)> changed_;
  mutable absl::Mutex mutex_;  // taken before the locks of the registry
  std::map<std::string, Running> running_ ABSL_GUARDED_BY(mutex_);  // by policy; judged here
};

}  // namespace spikeserve
