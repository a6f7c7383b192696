// Compacts the idle sessions of a store, and in the end takes them out, in a thread of its own.
#ifndef CORE_SESSION_SESSION_REAPER_H_
#define CORE_SESSION_SESSION_REAPER_H_

#include <cstdint>
#include <functional>
#include <thread>

#include "absl/synchronization/notification.h"
#include "absl/time/time.h"
#include "core/session/session_store.h"

namespace spikeserve {

// What becomes of a session that nobody uses, and when.
struct IdleLimits {
  absl::Duration compact_after;
  absl::Duration time_to_live;
};

class SessionReaper {
 public:
  // Looks through `store` four times within the shorter limit, and tells `on_reaped` how many
  // sessions went, where any did. `store` must outlive the reaper; `on_reaped` is called from its
  // thread.
  SessionReaper(SessionStore* store, const IdleLimits& limits,
                std::function<void(int64_t)> on_reaped);

  // Stops the thread and waits for it.
  ~SessionReaper();

 private:
  absl::Notification stop_;
  std::thread thread_;
};

}  // namespace spikeserve

#endif  // CORE_SESSION_SESSION_REAPER_H_
