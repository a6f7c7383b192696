// What a call leaves to do besides its answer.
#ifndef SERVER_AGENT_DEFERRED_WORK_H_
#define SERVER_AGENT_DEFERRED_WORK_H_

#include <memory>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/status/status.h"
#include "core/session/session_store.h"
#include "server/agent/shadow_runner.h"

namespace spikeserve {

// Once answers have been sent: the action tokens of the sessions that decided, and what their
// shadows are to see. Before that, where a part of a call was refused: its caller waits as if all
// of it had been. Not thread-safe: one call's own.
class DeferredWork {
 public:
  // `shadows` must outlive this object.
  void Add(std::shared_ptr<SessionEntry> entry, ShadowRunner* shadows) {
    entries_.push_back(std::move(entry));
    shadows_ = shadows;
  }
  // REQUIRES: the thread holds no session's lock.
  void Run();

  void set_refusal(absl::Status refusal) { refusal_ = std::move(refusal); }
  const absl::Status& refusal() const { return refusal_; }  // OK: nothing was refused

 private:
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries_;
  ShadowRunner* shadows_ = nullptr;
  absl::Status refusal_;
};

}  // namespace spikeserve

#endif  // SERVER_AGENT_DEFERRED_WORK_H_
