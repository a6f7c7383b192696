// Bounds how many frames of one kind a peer may send.
//
// Not thread-safe.
#pragma once

#include <algorithm>
#include <cstdint>

#include "absl/time/time.h"

namespace spikeserve {

// A token bucket that holds the frames of one second.
class FrameBudget {
 public:
  // Admits `per_second` frames a second on average, and as many at once.
  explicit FrameBudget(int64_t per_second)
      : per_second_(static_cast<double>(per_second)), available_(per_second_) {}

  // Counts one frame at `now`, the time of a monotonic clock. Returns false if the peer has sent
  // too many.
  bool Take(absl::Duration now) {
    if (available_ < 1.0) Refill(now);
    if (available_ < 1.0) return false;
    available_ -= 1.0;
    return true;
  }

  // Admits further frames, because a frame was sent that the peer may answer: gRPC's C++ client
  // answers data with WINDOW_UPDATE for the stream and for the connection, and with PING.
  void Earn() { available_ = std::min(available_ + kEarned, kMostEarned); }

 private:
  static constexpr double kEarned = 4.0;
  static constexpr double kMostEarned = 100'000.0;

  void Refill(absl::Duration now) {
    available_ =
        std::min(per_second_, available_ + per_second_ * absl::ToDoubleSeconds(now - refilled_));
    refilled_ = now;
  }

  const double per_second_;
  double available_;
  absl::Duration refilled_;  // of the clock; zero, long ago, before the first refill
};

}  // namespace spikeserve
