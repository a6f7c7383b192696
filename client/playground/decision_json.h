// Writes decisions as JSON, with the fields of the server's ExplainResponse (policy_service.proto)
// that the code of the status page draws, so that it draws these, too. Numbers are numbers, also
// those of 64 bits.
//
// Free functions, thread-safe.
#pragma once

#include "core/agent/served_policy.h"
#include "core/engine/trace.h"
#include "core/session/session.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Returns the last decision of a session without its inside: rasters, attention and routing are
// empty. REQUIRES: the running episode has a decision.
nlohmann::json DecisionToJson(const ServedPolicy& served, const Session& session);

// Adds the inside of a decision.
void AddTrace(const Trace& trace, nlohmann::json* decision);

}  // namespace spikeserve
