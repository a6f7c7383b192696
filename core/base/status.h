// Adds to a status the place that it came from.
//
// Pure functions; safe to call from many threads.
#ifndef CORE_BASE_STATUS_H_
#define CORE_BASE_STATUS_H_

#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns `status` with "`prefix`: " before its message, the same code and the same payloads; OK if
// it is OK. Annotate(NotFound("no such file"), "--tokens") says "--tokens: no such file".
absl::Status Annotate(const absl::Status& status, absl::string_view prefix);

}  // namespace spikeserve

#endif  // CORE_BASE_STATUS_H_
