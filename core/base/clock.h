// Provides time through an interface, so that tests can replace the machine's clock with one that
// they control.
#pragma once

#include <chrono>

#include "absl/time/time.h"

namespace spikeserve {

// Tells the time. Implementations are thread-safe.
class Clock {
 public:
  virtual ~Clock() = default;

  // Returns the time since an arbitrary fixed origin, so only differences are meaningful. Never
  // decreases.
  virtual absl::Duration Now() const = 0;
};

// Reads the machine's monotonic clock.
class SteadyClock final : public Clock {
 public:
  absl::Duration Now() const override {
    return absl::FromChrono(std::chrono::steady_clock::now().time_since_epoch());
  }
};

}  // namespace spikeserve
