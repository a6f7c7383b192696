// Limits how many sessions may be open at a time.
#pragma once

#include "absl/status/status.h"

namespace spikeserve {

// Implementations are thread-safe and return quickly.
class SessionQuota {
 public:
  virtual ~SessionQuota() = default;

  // Counts a session that is opened. RESOURCE_EXHAUSTED if the limit is reached.
  virtual absl::Status Acquire() = 0;

  // Counts the end of a session for which Acquire returned OK.
  virtual void Release() = 0;
};

}  // namespace spikeserve
