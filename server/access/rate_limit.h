// Limits the rate of events and allows bursts, with the generic cell rate algorithm (ITU-T I.371):
// a token bucket whose state is one number.
//
//   RateLimit limit;
//   limit.Set(/*per_second=*/100);
//   if (limit.Acquire(clock.Now()) > absl::ZeroDuration()) return TooManyRequests();
//
// Thread-safe, without locks.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>

#include "absl/time/time.h"

namespace spikeserve {

class RateLimit {
 public:
  // Allows `per_second` events a second on average, and a burst of one second's events, at least
  // one. 0 means no limit.
  void Set(double per_second) {
    const double period = per_second > 0.0 ? std::max(1.0, std::round(1e9 / per_second)) : 0.0;
    period_ns_.store(static_cast<int64_t>(period), std::memory_order_relaxed);
  }

  // Returns true if there is a limit.
  bool is_limited() const { return period_ns_.load(std::memory_order_relaxed) != 0; }

  // Returns zero and counts the event if it is within the limit. Otherwise returns the time to wait
  // and counts nothing. `now` is the time of a monotonic clock, the same clock in every call.
  absl::Duration Acquire(absl::Duration now) {
    const int64_t period = period_ns_.load(std::memory_order_relaxed);
    if (period == 0) return absl::ZeroDuration();
    const int64_t now_ns = absl::ToInt64Nanoseconds(now);
    // max(): below one event a second the period is longer than the burst, and one event must fit.
    const int64_t latest = now_ns + std::max(kBurstNs, period);
    int64_t arrival = theoretical_arrival_ns_.load(std::memory_order_relaxed);
    while (true) {
      const int64_t next = std::max(arrival, now_ns) + period;
      if (next > latest) return absl::Nanoseconds(next - latest);
      if (theoretical_arrival_ns_.compare_exchange_weak(arrival, next, std::memory_order_relaxed)) {
        return absl::ZeroDuration();
      }
    }
  }

 private:
  static constexpr int64_t kBurstNs = 1'000'000'000;  // one second's events

  std::atomic<int64_t> period_ns_ = 0;  // between two events; 0: no limit
  // The theoretical arrival time of I.371: when the next event would be due if all events so far
  // had come one period apart.
  std::atomic<int64_t> theoretical_arrival_ns_ = 0;
};

}  // namespace spikeserve
