// Holds the engine's context of one session: a cache, which is rebuilt from the session's history
// before a decision if it is absent. Answers do not depend on whether it was.
//
// Not thread-safe: protected by the lock of its session.
#pragma once

#include <memory>
#include <utility>
#include <vector>

#include "core/agent/served_policy.h"
#include "core/engine/engine.h"
#include "core/session/session.h"

namespace spikeserve {

class ContextCache {
 public:
  // Rebuilds the context if it is absent: the same calls with the same numbers leave the same keys
  // and values in it.
  void Fill(const ServedPolicy& served, const Session& session);

  // Returns the context for a decision, whose action is then pending: the context lacks it.
  // REQUIRES: Fill() was called; no action is pending.
  Engine::Context* StartDecision();

  // Returns whether an action is pending, and counts it as appended.
  bool TakePending() { return std::exchange(is_pending_, false); }
  // Returns the context with the last action of `session`, encoded in `memory`, which is to be
  // appended to it. REQUIRES: TakePending() returned true.
  Engine::TakenAction LastAction(const ServedPolicy& served, const Session& session,
                                 std::vector<float>* memory) const;

  // The last action in the history was replaced by an executed one.
  void OnExecuted();
  // The agent reports executed actions: the next request may replace the last action, which is
  // therefore appended by that request.
  void ExpectExecuted() { expects_executed_ = true; }
  bool expects_executed() const { return expects_executed_; }

  // Frees the context.
  void Drop();

 private:
  std::unique_ptr<Engine::Context> context_;  // null: absent
  bool is_pending_ = false;
  bool expects_executed_ = false;
};

}  // namespace spikeserve
