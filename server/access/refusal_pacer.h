// How long a caller who was refused waits, so that refusing costs the others nothing.
//
// Thread-safe, without locks.
#ifndef SERVER_ACCESS_REFUSAL_PACER_H_
#define SERVER_ACCESS_REFUSAL_PACER_H_

#include <atomic>
#include <cstddef>
#include <cstdint>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

// One for each who is refused together: a tenant, or all whose token is not good. However many
// callers go on asking, it lets 500 of them a second, or 4 MiB of what they send, have their
// refusal, one after the other.
class RefusalPacer {
 public:
  // How long whoever is answered with `status` to a request of so many bytes waits, from `now` on;
  // zero where it is no refusal: of a token that is not good, or of more than a caller's share.
  // A tenth of a second on average for the first, of random length, so that callers who were
  // refused together do not come back together; longer for those who come behind others, at most 2
  // seconds and one more for each MiB. `now` is on any clock that never goes back, always the same.
  absl::Duration DelayFor(const absl::Status& status, size_t request_bytes, absl::Duration now);

 private:
  std::atomic<int64_t> free_at_ns_ = 0;  // when those before will have had their turn
};

}  // namespace spikeserve

#endif  // SERVER_ACCESS_REFUSAL_PACER_H_
