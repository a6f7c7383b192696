// Compacts the idle sessions of a store and finally removes them, in a thread of its own.
//
// Time in which the process did not run, for example because it was stopped, does not count as
// idle: the requests of that time still wait to be read.
#pragma once

#include <algorithm>
#include <cstdint>
#include <functional>
#include <thread>
#include <utility>

#include "absl/time/time.h"
#include "core/base/clock.h"
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
                std::function<void(int64_t)> on_reaped)
      : thread_([this, store, limits, on_reaped = std::move(on_reaped)] {
          const absl::Duration pause = std::min(limits.compact_after, limits.time_to_live) / 4;
          const SteadyClock clock;
          absl::Duration last = clock.Now();
          while (!stop_.WaitFor(pause)) {
            const absl::Duration overslept = clock.Now() - last - pause;
            if (overslept > pause) store->Forgive(overslept);
            last = clock.Now();
            const int64_t reaped = store->RemoveIdle(limits.time_to_live);
            if (reaped > 0) on_reaped(reaped);
            store->CompactIdle(limits.compact_after);
          }
        }) {}

  // Stops the thread and waits for it.
  ~SessionReaper() {
    stop_.Notify();
    thread_.join();
  }

 private:
  SteadyNotification stop_;
  std::thread thread_;
};

}  // namespace spikeserve
