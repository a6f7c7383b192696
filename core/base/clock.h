// Time as something that is passed in, so that tests can hold it still.
//
// A clock is safe to use from many threads.
#ifndef CORE_BASE_CLOCK_H_
#define CORE_BASE_CLOCK_H_

#include <chrono>

#include "absl/time/time.h"

namespace spikeserve {

class Clock {
 public:
  virtual ~Clock() = default;

  // Time since a fixed point that means nothing by itself. Never goes back.
  virtual absl::Duration Now() const = 0;
};

// The machine's monotonic clock.
class SteadyClock final : public Clock {
 public:
  absl::Duration Now() const override {
    return absl::FromChrono(std::chrono::steady_clock::now().time_since_epoch());
  }
};

}  // namespace spikeserve

#endif  // CORE_BASE_CLOCK_H_
