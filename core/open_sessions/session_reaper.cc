#include "core/open_sessions/session_reaper.h"

#include <algorithm>
#include <utility>

#include "core/base/clock.h"

namespace spikeserve {

SessionReaper::SessionReaper(SessionStore* store, const IdleLimits& limits,
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

SessionReaper::~SessionReaper() {
  stop_.Notify();
  thread_.join();
}

}  // namespace spikeserve
