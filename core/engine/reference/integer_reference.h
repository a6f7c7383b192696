// Computes the SNN-DT in integer arithmetic in naive loops: the executable form of
// docs/design/integer.md.
#pragma once

#include "core/engine/engine.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

// As ComputeSpikingReference (reference_engine.h), for policies with Arithmetic::kInteger. An
// attention row holds for a group of ticks, so each layer's trace repeats it, as well as the gates,
// at each of them. Thread-safe.
void ComputeIntegerReference(const Policy& policy, const PrefixContext& prefix,
                             Engine::Output* output, Trace* trace);

}  // namespace spikeserve
