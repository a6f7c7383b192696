// Recomputes one decision and records its spikes, attention and gates.
#pragma once

#include "core/engine/engine.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

// Recomputes the decision at the last token of `prefix`, a state token, with the reference engine
// of the policy's mode. Writes the result into `output` and the recording into `trace`. `prefix`
// holds the last HistorySize() timesteps, or the whole episode if it is shorter. Thread-safe.
void TraceDecision(const Policy& policy, const PrefixContext& prefix, Engine::Output* output,
                   Trace* trace);

}  // namespace spikeserve
