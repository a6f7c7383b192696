#include "server/access/refusal_pacer.h"

#include <algorithm>

#include "absl/random/random.h"

namespace spikeserve {
namespace {

constexpr double kMiB = 1 << 20;

bool IsRefusal(const absl::Status& status) {
  return absl::IsUnauthenticated(status) || absl::IsPermissionDenied(status) ||
         absl::IsResourceExhausted(status);
}

}  // namespace

absl::Duration RefusalPacer::DelayFor(const absl::Status& status, size_t request_bytes,
                                      absl::Duration now) {
  if (!IsRefusal(status)) return absl::ZeroDuration();
  refusals_.fetch_add(1, std::memory_order_relaxed);
  thread_local absl::InsecureBitGen bits;
  const double size = static_cast<double>(request_bytes) / kMiB;
  const absl::Duration turn = absl::Milliseconds(2) + absl::Milliseconds(250) * size;
  const absl::Duration longest = absl::Seconds(2) + absl::Seconds(1) * size;
  absl::Duration queue;
  int64_t free_at = free_at_ns_.load(std::memory_order_relaxed);
  do {
    queue = std::max(absl::Nanoseconds(free_at) - now, absl::ZeroDuration());
    if (queue > longest) break;  // takes no turn; otherwise the queue would grow without bound
  } while (!free_at_ns_.compare_exchange_weak(free_at, absl::ToInt64Nanoseconds(now + queue + turn),
                                              std::memory_order_relaxed));
  return std::min(queue, longest) + absl::Milliseconds(absl::Uniform(bits, 50.0, 150.0));
}

}  // namespace spikeserve
