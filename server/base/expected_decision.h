// Attaches to an error of a request that came out of order what the session expects instead, as
// google.rpc.ErrorInfo with the reason OUT_OF_ORDER.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_BASE_EXPECTED_DECISION_H_
#define SERVER_BASE_EXPECTED_DECISION_H_

#include <cstdint>
#include <optional>

#include "absl/status/status.h"

namespace spikeserve {

// Returns `status` with the number of the next decision of the session, from 0, and its step in the
// episode. REQUIRES: `status` is not OK.
absl::Status WithExpectedDecision(absl::Status status, uint64_t decision, int64_t step);

// Returns the decision that WithExpectedDecision attached to `status`, if any.
std::optional<uint64_t> ExpectedDecision(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_BASE_EXPECTED_DECISION_H_
