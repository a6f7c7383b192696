// Compacts the idle sessions of a store and finally removes them, in a thread of its own.
//
// Time in which the process did not run, for example because it was stopped, does not count as
// idle: the requests of that time still wait to be read.
#pragma once

#include <cstdint>
#include <functional>
#include <thread>

#include "absl/time/time.h"
#include "core/base/steady_wait.h"
#include "core/open_sessions/session_store.h"

namespace spikeserve {

// Idle times after which a session is compacted and removed.
struct IdleLimits {
  absl::Duration compact_after;
  absl::Duration time_to_live;
};

// Runs the thread from construction to destruction.
class SessionReaper {
 public:
  // Scans `store` four times within the shorter of the two limits. If sessions were removed, calls
  // `on_reaped` with their number, from the reaper's thread. `store` must outlive the reaper.
  SessionReaper(SessionStore* store, const IdleLimits& limits,
                std::function<void(int64_t)> on_reaped);

  // Stops the thread and waits for it.
  ~SessionReaper();

 private:
  SteadyNotification stop_;
  std::thread thread_;
};

}  // namespace spikeserve
