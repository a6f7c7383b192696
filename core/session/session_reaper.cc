#include "core/session/session_reaper.h"

#include <utility>

namespace spikeserve {

SessionReaper::SessionReaper(SessionStore* store, absl::Duration time_to_live,
                             std::function<void(int64_t)> on_reaped)
    : thread_([this, store, time_to_live, on_reaped = std::move(on_reaped)] {
        while (!stop_.WaitForNotificationWithTimeout(time_to_live / 4)) {
          if (const int64_t reaped = store->RemoveIdle(time_to_live); reaped > 0) on_reaped(reaped);
        }
      }) {}

SessionReaper::~SessionReaper() {
  stop_.Notify();
  thread_.join();
}

}  // namespace spikeserve
