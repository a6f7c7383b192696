// Work of a call that runs after its answer was sent.
#pragma once

#include <memory>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "core/open_sessions/session_store.h"
#include "server/followers/shadow_runner.h"

namespace spikeserve {

// Collects the sessions that decided during a call. Run() appends the action tokens of their
// decisions to their contexts and submits the steps that their shadows replay. Neither is needed
// for the answer.
//
//   DeferredWork deferred;
//   handler.Act(caller, request, &response, &deferred);
//   Send(response);
//   deferred.Run();
//
// Not thread-safe: one call owns it.
class DeferredWork {
 public:
  // Adds a session that decided. `shadows` must outlive this object.
  void Add(std::shared_ptr<SessionEntry> entry, ShadowRunner* shadows) {
    entries_.push_back(std::move(entry));
    shadows_ = shadows;
  }
  // Does the work of all added sessions, then forgets them. REQUIRES: the calling thread holds no
  // session lock.
  void Run();

 private:
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries_;
  ShadowRunner* shadows_ = nullptr;
};

}  // namespace spikeserve
