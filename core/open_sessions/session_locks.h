// Locks several sessions at once.
#pragma once

#include <algorithm>
#include <functional>
#include <memory>

#include "absl/base/thread_annotations.h"
#include "absl/container/inlined_vector.h"
#include "absl/types/span.h"
#include "core/open_sessions/session_store.h"

namespace spikeserve {

// Takes the locks in the order of their addresses, whatever the order of the entries is, so that
// two threads that lock the same sessions cannot deadlock. An entry may occur twice. Clang's
// thread-safety analysis cannot follow locks in a container, so callers assert the lock of a
// session before they use it:
//
//   const SessionLocks locks(entries);
//   entries[0]->mutex.AssertHeld();
class SessionLocks {
 public:
  // REQUIRES: the calling thread holds no session's lock.
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
