// Explains a session's last decision by recomputing it from the session's value.
#pragma once

#include <vector>

#include "absl/status/statusor.h"
#include "core/engine/trace.h"
#include "core/model/policy.h"
#include "core/session/session.h"

namespace spikeserve {

// The recomputed decision with its trace.
struct Explanation {
  std::vector<float> readout;  // [d]: input of the action head
  Trace trace;                 // its spikes add up, stage by stage, to the answer's counts
};

// Recomputes `session.last_answer`, which `policy` gave. Takes about a thousand times as long as
// the decision. Thread-safe. FAILED_PRECONDITION if the running episode has no decision yet;
// INTERNAL if the counts of the recomputed decision differ from those of the answer.
absl::StatusOr<Explanation> Explain(const Policy& policy, const Session& session);

}  // namespace spikeserve
