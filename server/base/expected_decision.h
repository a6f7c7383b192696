// Attaches to an error of a request that came out of order what the session expects instead, as
// google.rpc.ErrorInfo with the reason OUT_OF_ORDER.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <optional>

#include "absl/status/status.h"

namespace spikeserve {

// The next decision of a session: its number in the session, its episode and its step there, from
// 0.
struct NextDecision {
  uint64_t decision = 0;
  int64_t episode = 0;
  int64_t step = 0;
};

// Returns `status` with what the session expects. REQUIRES: `status` is not OK.
absl::Status WithExpectedDecision(absl::Status status, const NextDecision& expected);

// Returns what WithExpectedDecision attached to `status`, if anything.
std::optional<NextDecision> ExpectedDecisionOf(const absl::Status& status);

}  // namespace spikeserve
