// So many events a second, with bursts: the generic cell rate algorithm (ITU-T I.371), a token
// bucket whose whole state is one number.
//
// Thread-safe, without locks.
#ifndef SERVER_ACCESS_RATE_LIMIT_H_
#define SERVER_ACCESS_RATE_LIMIT_H_

#include <atomic>
#include <cstdint>

#include "absl/time/time.h"

namespace spikeserve {

class RateLimit {
 public:
  // At most `per_second` in the long run, and as many as that at once; 0: no limit.
  void Set(double per_second);

  // Zero where the event may happen, which counts it; else how long to wait, and nothing changes.
  // `now` is on any clock that never goes back, always the same one.
  absl::Duration Acquire(absl::Duration now);

 private:
  static constexpr int64_t kBurstNs = 1'000'000'000;  // a second's worth

  std::atomic<int64_t> period_ns_ = 0;      // between events; 0: no limit
  std::atomic<int64_t> full_until_ns_ = 0;  // when all that was taken will have been earned
};

}  // namespace spikeserve

#endif  // SERVER_ACCESS_RATE_LIMIT_H_
