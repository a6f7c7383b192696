// The SNN-DT as naive loops straight from the equations: the definition of every sum's order.
#ifndef CORE_ENGINE_REFERENCE_REFERENCE_ENGINE_H_
#define CORE_ENGINE_REFERENCE_REFERENCE_ENGINE_H_

#include <memory>

#include "core/engine/engine.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

// Recomputes the whole episode at every decision, and shares no arithmetic with the streaming
// engine beyond the neuron, LayerNorm and the exponential. Slow by design; for tests. REQUIRES: a
// valid policy of a spiking mode.
std::unique_ptr<Engine> MakeSpikingReferenceEngine(std::shared_ptr<const Policy> policy);

// The decision at the last token of `prefix`, a state token; recorded in `trace`, unless null,
// whose `layers` has L elements. Thread-safe.
void ComputeSpikingReference(const Policy& policy, const PrefixContext& prefix,
                             Engine::Output* output, Trace* trace);

}  // namespace spikeserve

#endif  // CORE_ENGINE_REFERENCE_REFERENCE_ENGINE_H_
