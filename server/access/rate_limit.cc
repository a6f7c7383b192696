#include "server/access/rate_limit.h"

#include <algorithm>
#include <cmath>

namespace spikeserve {

void RateLimit::Set(double per_second) {
  const double period = per_second > 0.0 ? std::max(1.0, std::round(1e9 / per_second)) : 0.0;
  period_ns_.store(static_cast<int64_t>(period), std::memory_order_relaxed);
}

absl::Duration RateLimit::Acquire(absl::Duration now) {
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

}  // namespace spikeserve
