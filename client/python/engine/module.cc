#include "absl/synchronization/mutex.h"
#include "client/python/engine/bindings.h"

NB_MODULE(_engine, module) {
  // Debian builds Abseil with this check, which costs a batch a comparison of each two sessions.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  module.doc() = "The streaming engine and sessions of spikeserve.";
  spikeserve::BindValues(module);
  spikeserve::BindExplanation(module);
  spikeserve::BindEngine(module);
}
