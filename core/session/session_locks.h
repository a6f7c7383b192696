// Several sessions' locks, held at a time.
#ifndef CORE_SESSION_SESSION_LOCKS_H_
#define CORE_SESSION_SESSION_LOCKS_H_

#include <algorithm>
#include <functional>
#include <memory>

#include "absl/base/thread_annotations.h"
#include "absl/container/inlined_vector.h"
#include "absl/types/span.h"
#include "core/session/session_store.h"

namespace spikeserve {

// Takes the locks by address, whatever the order of the entries, so that two who want the same
// sessions never wait for each other. An entry may be there twice. Clang cannot follow a lock that
// is one of many: whoever uses a session asserts it.
class SessionLocks {
 public:
  // REQUIRES: the thread holds no session's lock.
  explicit SessionLocks(absl::Span<const std::shared_ptr<SessionEntry>> entries)
      ABSL_NO_THREAD_SAFETY_ANALYSIS {
    for (const auto& entry : entries) held_.push_back(entry);
    std::sort(held_.begin(), held_.end());
    held_.erase(std::unique(held_.begin(), held_.end()), held_.end());
    for (const auto& entry : held_) entry->mutex.Lock();
  }
  ~SessionLocks() ABSL_NO_THREAD_SAFETY_ANALYSIS {
    for (const auto& entry : held_) entry->mutex.Unlock();
  }
  SessionLocks(const SessionLocks&) = delete;
  SessionLocks& operator=(const SessionLocks&) = delete;

 private:
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 16> held_;
};

}  // namespace spikeserve

#endif  // CORE_SESSION_SESSION_LOCKS_H_
