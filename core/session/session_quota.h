// How many sessions somebody may have open at a time.
#ifndef CORE_SESSION_SESSION_QUOTA_H_
#define CORE_SESSION_SESSION_QUOTA_H_

#include "absl/status/status.h"

namespace spikeserve {

// Implementations are safe to call from many threads, and quick.
class SessionQuota {
 public:
  virtual ~SessionQuota() = default;

  // Counts a session that opens. RESOURCE_EXHAUSTED where there may be no more.
  virtual absl::Status Acquire() = 0;

  // Counts the end of one that was taken.
  virtual void Release() = 0;
};

}  // namespace spikeserve

#endif  // CORE_SESSION_SESSION_QUOTA_H_
