// The time by which the client measures its waits. A step of the time of day does not change it.
//
// Free function without shared state; safe to call from many threads.
#ifndef CLIENT_SRC_STEADY_TIME_H_
#define CLIENT_SRC_STEADY_TIME_H_

#include <chrono>

#include "absl/time/time.h"

namespace spikeserve {

// Returns the time since a fixed point in the past, by the monotonic clock.
inline absl::Duration SteadyNow() {
  return absl::FromChrono(std::chrono::steady_clock::now().time_since_epoch());
}

}  // namespace spikeserve

#endif  // CLIENT_SRC_STEADY_TIME_H_
