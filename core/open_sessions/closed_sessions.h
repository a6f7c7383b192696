// Keeps sessions of a fleet that have left their store while episodes waited for verdicts, which
// teach the fleet's head all the same. The journals of these sessions end when they are forgotten,
// so that other servers find what waits, too, if this one dies. Until then they count against the
// limits of open sessions, which bound the memory of both.
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

namespace spikeserve {

struct SessionEntry;

class ClosedSessions {
 public:
  // Returns whether it keeps the session. Does not if no episode waits, the head is private, or
  // another server has the session.
  bool Keep(const std::string& id, const std::shared_ptr<SessionEntry>& entry)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns a session of `tenant`, or null.
  std::shared_ptr<SessionEntry> Find(const std::string& id, const std::string& tenant)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Learns from episodes whose time is over as they are, and then calls `visit` for every session.
  // Forgets sessions for which no episode has waited for a minute, or none waits after their time,
  // and returns them. To be called from time to time.
  std::vector<std::shared_ptr<SessionEntry>> Settle(absl::FunctionRef<void(SessionEntry&)> visit)
      ABSL_LOCKS_EXCLUDED(mutex_);

  int64_t size() const ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  struct Closed {
    std::shared_ptr<SessionEntry> entry;
    absl::Time until;
  };

  mutable absl::Mutex mutex_;
  // By tenant and id, which a session that was opened again may share.
  std::multimap<std::pair<std::string, std::string>, Closed> closed_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
