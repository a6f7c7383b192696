// Defines one policy version as it is served: its engine, the learning that its sessions share, and
// the observer of its sessions.
#pragma once

#include <atomic>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/types/span.h"
#include "core/agent/operator_seat.h"
#include "core/agent/robot_link.h"
#include "core/agent/wiring_check.h"
#include "core/engine/engine.h"
#include "core/learning/fleet_head.h"
#include "core/learning/head_update.h"
#include "core/learning/tenant_heads.h"
#include "core/session/episode.h"
#include "core/session/session.h"

namespace spikeserve {

class HeadLog;
class SessionListener;

// Observes the sessions of a policy. Every event is reported once; retries and rebuilt caches are
// not reported. Implementations are thread-safe, return quickly, and never call
// back into a session.
class SessionObserver {
 public:
  virtual ~SessionObserver() = default;

  virtual void OnOpen() {}
  // A roll-out has assigned this version to a new session of `tenant`. Returns what listens to the
  // session, to compare the version; null: no roll-out is running.
  virtual std::shared_ptr<SessionListener> OnAssigned(absl::string_view /*tenant*/) {
    return nullptr;
  }
  // Counts the elements of a new observation, and the return-to-go, that lie far from the training
  // data, and returns their number.
  virtual uint32_t CountUnusual(absl::Span<const float> /*observation*/, double /*return_to_go*/) {
    return 0;
  }
  virtual void OnDecision(const Answer& /*answer*/) {}
  // A step that an agent took without the server was appended, as `answer`, which was not sent.
  virtual void OnBeat(const Answer& /*answer*/) {}
  // The action of a step was executed, and `source` has chosen it.
  virtual void OnExecuted(SourceKind /*source*/) {}
  // An operator's control of a session has begun or ended.
  virtual void OnSeat(SeatChange /*change*/) {}
  // Steps of which only the rewards are known were counted.
  virtual void OnSkippedBeats(int64_t /*beats*/) {}
  // A request came too late for its answer to be of use.
  virtual void OnExpired() {}
  // A request asked again for an answer that was given.
  virtual void OnRepeated() {}
  // A request repeated a step with another content than the one that was taken, and was refused.
  virtual void OnConflict() {}
  // Rewards after step 0 were left out, and counted as 0.
  virtual void OnMissingRewards(int64_t /*rewards*/) {}
  // A robot reported what it did since its last report.
  virtual void OnReport(const BeatCounts& /*beats*/) {}
  // A robot reported more than can have happened in the time. It counts nowhere else.
  virtual void OnImplausible() {}
  // A request for a decision was refused or failed; the session is unchanged.
  virtual void OnError() {}
  // The policy computed an answer with NaN or infinity, which was not sent.
  virtual void OnNonFinite() {}
  // A verdict about the wiring of the session `id` begins, in words `text`. `response` is what
  // follows from it.
  virtual void OnWiring(const std::string& /*id*/, WiringCause /*cause*/,
                        const std::string& /*text*/, WiringResponse /*response*/) {}
  // Returns the response to verdicts in sessions that ask for none.
  virtual WiringResponse wiring_response() const { return WiringResponse::kCount; }
  virtual void OnEpisodeEnd(double /*episode_return*/) {}
  virtual void OnHeadUpdate(UpdateOutcome /*outcome*/) {}
  virtual void OnLearned(const LearningSummary& /*summary*/) {}  // end of an episode with learning
  virtual void OnClose() {}
};

// Pauses and resumes the learning of a policy's sessions. Thread-safe.
class LearningSwitch {
 public:
  bool paused() const { return paused_.load(std::memory_order_relaxed); }

  // Sets the switch. Waits for running merges, so after a pause no shared head of the policy
  // changes any more.
  void set_paused(bool paused) ABSL_LOCKS_EXCLUDED(merging_) {
    const absl::WriterMutexLock lock(&merging_);
    paused_.store(paused, std::memory_order_relaxed);
  }

  // Calls `merge`, which changes a shared head, and returns true. Returns false without calling it
  // if learning is paused. Several threads may merge at the same time.
  bool MergeUnlessPaused(absl::FunctionRef<void()> merge) ABSL_LOCKS_EXCLUDED(merging_) {
    const absl::ReaderMutexLock lock(&merging_);
    if (paused()) return false;
    merge();
    return true;
  }

 private:
  absl::Mutex merging_;  // shared by merges, so that a pause can wait for them
  std::atomic<bool> paused_ = false;
};

// Immutable and shared, except for what its sessions learn together. A session keeps the version
// that it was opened with.
struct ServedPolicy {
  std::string name;
  int64_t version = 0;  // >= 1
  std::string sha256;   // of the policy's file, in hexadecimal; empty: not read from a file
  std::shared_ptr<const Engine> engine;
  std::shared_ptr<SessionObserver> observer;
  std::shared_ptr<TenantHeads> heads;  // learned by the fleet sessions
  bool share_heads = false;            // by all tenants: they learn the head without a name
  // The log that changes the heads (head_log.h); null: they are those of this process alone.
  std::shared_ptr<HeadLog> log;
  // Shared by all versions of the policy that are served at the same time.
  std::shared_ptr<LearningSwitch> learning = std::make_shared<LearningSwitch>();

  const Policy& policy() const { return engine->policy(); }

  // Returns the name in `heads` of the head that a tenant learns.
  std::string HeadName(const std::string& tenant) const { return share_heads ? "" : tenant; }
  std::shared_ptr<FleetHead> HeadOf(const std::string& tenant) const {
    return heads->Of(HeadName(tenant));
  }
  // Returns null if the tenant has learned nothing yet.
  std::shared_ptr<FleetHead> FindHead(const std::string& tenant) const {
    return heads->Find(HeadName(tenant));
  }
};

}  // namespace spikeserve
