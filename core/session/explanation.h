// A session's last decision from the inside, recomputed from the session's value alone.
#ifndef CORE_SESSION_EXPLANATION_H_
#define CORE_SESSION_EXPLANATION_H_

#include <vector>

#include "absl/status/statusor.h"
#include "core/engine/trace.h"
#include "core/model/policy.h"
#include "core/session/session.h"

namespace spikeserve {

struct Explanation {
  std::vector<float> readout;  // [d]: what the action head saw
  Trace trace;                 // its spikes add up, stage by stage, to the answer's counts
};

// Explains `session.last_answer`, which `policy` gave. Takes a hundred times as long as the
// decision did. Thread-safe. FAILED_PRECONDITION where the running episode has no decision yet;
// INTERNAL if the decision comes out otherwise than it was answered.
absl::StatusOr<Explanation> Explain(const Policy& policy, const Session& session);

}  // namespace spikeserve

#endif  // CORE_SESSION_EXPLANATION_H_
