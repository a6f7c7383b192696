// Delays replies to refused callers, so that callers who retry at once cannot take the server's
// time from the others.
//
// Thread-safe, without locks.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

// Spaces the refusals of one group of callers: at most 500 a second or 4 MiB of requests a second.
// A group is a tenant, or all callers without a valid token.
//
//   absl::Duration delay = pacer.DelayFor(status, request.ByteSizeLong(), clock.Now());
//   // Send `status` after `delay`; send it now if `delay` is zero.
class RefusalPacer {
 public:
  // Returns how long to delay the reply to a request of `request_bytes`, counted from `now`.
  // Returns zero unless `status` is a refusal: UNAUTHENTICATED, PERMISSION_DENIED or
  // RESOURCE_EXHAUSTED. The delay is the time until the group's earlier refusals have been sent, at
  // most 2 s plus 1 s a MiB, plus a random 50 to 150 ms, so that callers who were refused together
  // do not retry together. `now` is the time of a monotonic clock, the same clock in every call.
  absl::Duration DelayFor(const absl::Status& status, size_t request_bytes, absl::Duration now);

  // Returns how many refusals there were.
  int64_t refusals() const { return refusals_.load(std::memory_order_relaxed); }

 private:
  std::atomic<int64_t> refusals_ = 0;
  std::atomic<int64_t> free_at_ns_ = 0;  // when the next refusal may be sent
};

}  // namespace spikeserve
