// Limits the rate of events and allows bursts, with the generic cell rate algorithm (ITU-T I.371):
// a token bucket whose state is one number.
//
//   RateLimit limit;
//   limit.Set(/*per_second=*/100);
//   if (limit.Acquire(clock.Now()) > absl::ZeroDuration()) return TooManyRequests();
//
// Thread-safe, without locks.
#pragma once

#include <atomic>
#include <cstdint>

#include "absl/time/time.h"

namespace spikeserve {

class RateLimit {
 public:
  // Allows `per_second` events a second on average, and a burst of one second's events, at least
  // one. 0 means no limit.
  void Set(double per_second);

  // Returns true if there is a limit.
  bool is_limited() const { return period_ns_.load(std::memory_order_relaxed) != 0; }

  // Returns zero and counts the event if it is within the limit. Otherwise returns the time to wait
  // and counts nothing. `now` is the time of a monotonic clock, the same clock in every call.
  absl::Duration Acquire(absl::Duration now);

 private:
  static constexpr int64_t kBurstNs = 1'000'000'000;  // one second's events

  std::atomic<int64_t> period_ns_ = 0;  // between two events; 0: no limit
  // The theoretical arrival time of I.371: when the next event would be due if all events so far
  // had come one period apart.
  std::atomic<int64_t> theoretical_arrival_ns_ = 0;
};

}  // namespace spikeserve
