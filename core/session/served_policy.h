// One policy version as it is served: its engine, and who is told what its sessions do.
#ifndef CORE_SESSION_SERVED_POLICY_H_
#define CORE_SESSION_SERVED_POLICY_H_

#include <atomic>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/synchronization/mutex.h"
#include "core/engine/engine.h"
#include "core/learning/fleet_head.h"
#include "core/learning/head_update.h"
#include "core/session/episode.h"
#include "core/session/session.h"

namespace spikeserve {

// Told once of everything that counts: retries, failed requests and rebuilt caches are not heard
// of. Implementations are safe to call from many threads, quick, and never call back into a
// session.
class SessionObserver {
 public:
  virtual ~SessionObserver() = default;

  virtual void OnOpen() {}
  virtual void OnDecision(const Answer& /*answer*/) {}
  virtual void OnEpisodeEnd(double /*episode_return*/) {}
  virtual void OnHeadUpdate(UpdateOutcome /*outcome*/) {}
  virtual void OnLearned(const LearningSummary& /*summary*/) {}  // a learning episode has ended
  virtual void OnClose() {}
};

// Whether the sessions of a policy learn. Thread-safe.
class LearningSwitch {
 public:
  bool paused() const { return paused_.load(std::memory_order_relaxed); }

  // Waits for the merges under way: once it returns, a paused policy's shared heads stand still.
  void set_paused(bool paused) ABSL_LOCKS_EXCLUDED(merging_) {
    const absl::WriterMutexLock lock(&merging_);
    paused_.store(paused, std::memory_order_relaxed);
  }

  // Calls `merge`, which changes a shared head, beside those of other threads. False, and it is not
  // called, where learning is paused.
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

// Immutable and shared, but for what its sessions learn together; a session holds on to the version
// it was opened with.
struct ServedPolicy {
  std::string name;
  int64_t version = 0;  // >= 1
  std::shared_ptr<const Engine> engine;
  std::shared_ptr<SessionObserver> observer;
  std::shared_ptr<FleetHead> fleet;
  // Of all versions of the policy that are served at a time.
  std::shared_ptr<LearningSwitch> learning = std::make_shared<LearningSwitch>();

  const Policy& policy() const { return engine->policy(); }
};

}  // namespace spikeserve

#endif  // CORE_SESSION_SERVED_POLICY_H_
