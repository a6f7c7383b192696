// The times by which the client measures. A step of the time of day changes neither.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <time.h>

#include <chrono>

#include "absl/time/time.h"

namespace spikeserve {

// Returns the time since a fixed point in the past, by the monotonic clock: for waits.
inline absl::Duration SteadyNow() {
  return absl::FromChrono(std::chrono::steady_clock::now().time_since_epoch());
}

// As SteadyNow, with the time in which the computer was suspended, where the system counts it: for
// the age of an observation. The monotonic clock of Linux stands still meanwhile, so that an old
// observation would be taken for a new one, and the server for a slow link.
inline absl::Duration RobotNow() {
#ifdef CLOCK_BOOTTIME
  timespec now;
  if (clock_gettime(CLOCK_BOOTTIME, &now) == 0) return absl::DurationFromTimespec(now);
#endif
  return SteadyNow();
}

}  // namespace spikeserve
