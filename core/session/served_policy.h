// One policy version as it is served: its engine, and who is told what its sessions do.
#ifndef CORE_SESSION_SERVED_POLICY_H_
#define CORE_SESSION_SERVED_POLICY_H_

#include <cstdint>
#include <memory>
#include <string>

#include "core/engine/engine.h"
#include "core/learning/head_update.h"
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
  virtual void OnHeadDrift(double /*ratio*/) {}  // where a learning session's episode has ended
  virtual void OnClose() {}
};

// Immutable and shared; a session holds on to the version it was opened with.
struct ServedPolicy {
  std::string name;
  int64_t version = 0;  // >= 1
  std::shared_ptr<const Engine> engine;
  std::shared_ptr<SessionObserver> observer;

  const Policy& policy() const { return engine->policy(); }
};

}  // namespace spikeserve

#endif  // CORE_SESSION_SERVED_POLICY_H_
