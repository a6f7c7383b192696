// Keeps sessions of a fleet that have left their store while episodes waited for verdicts, which
// teach the fleet's head all the same. The journals of these sessions end when they are forgotten,
// so that other servers find what waits, too, if this one dies.
//
// Thread-safe.
#pragma once

#include <cstddef>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

namespace spikeserve {

struct SessionEntry;

class ClosedSessions {
 public:
  static constexpr size_t kMost = 10'000;

  // Returns whether it keeps the session, until the time of its last episode is over. Does not if
  // none waits, the head is private, another server has the session, or too many are kept.
  bool Keep(const std::string& id, const std::shared_ptr<SessionEntry>& entry)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns a session of `tenant`, or null.
  std::shared_ptr<SessionEntry> Find(const std::string& id, const std::string& tenant)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Learns from episodes whose time is over as they are, and forgets sessions without any. To be
  // called from time to time.
  void Settle() ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  struct Closed {
    std::shared_ptr<SessionEntry> entry;
    absl::Time until;  // a repeated verdict gets its answer
  };

  absl::Mutex mutex_;
  // By tenant and id.
  std::map<std::pair<std::string, std::string>, Closed> closed_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
