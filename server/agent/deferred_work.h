// Work of a call that does not delay its answer.
#ifndef SERVER_AGENT_DEFERRED_WORK_H_
#define SERVER_AGENT_DEFERRED_WORK_H_

#include <memory>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "core/session/session_store.h"
#include "server/agent/shadow_runner.h"

namespace spikeserve {

// Work that a call leaves until its answer has been sent: the action tokens of the sessions that
// decided, and the steps that their shadow policies play. Not thread-safe: one call owns it.
class DeferredWork {
 public:
  // `shadows` must outlive this object.
  void Add(std::shared_ptr<SessionEntry> entry, ShadowRunner* shadows) {
    entries_.push_back(std::move(entry));
    shadows_ = shadows;
  }
  // REQUIRES: the thread holds no session's lock.
  void Run();

 private:
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries_;
  ShadowRunner* shadows_ = nullptr;
};

}  // namespace spikeserve

#endif  // SERVER_AGENT_DEFERRED_WORK_H_
