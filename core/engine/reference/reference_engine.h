// Computes the SNN-DT in naive loops that follow the equations. This engine defines the order of
// every sum.
#pragma once

#include <memory>

#include "core/engine/engine.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

// Creates an engine that recomputes the whole episode at every decision. It shares no arithmetic
// with the streaming engine except the neuron, LayerNorm and the exponential. Slow by design; for
// tests. REQUIRES: a valid policy of a spiking mode.
std::unique_ptr<Engine> MakeSpikingReferenceEngine(std::shared_ptr<const Policy> policy);

// Computes the decision at the last token of `prefix`, a state token. Records it in `trace` unless
// `trace` is null; trace->layers must have L elements. Thread-safe.
void ComputeSpikingReference(const Policy& policy, const PrefixContext& prefix,
                             Engine::Output* output, Trace* trace);

// As ComputeSpikingReference, for policies with Arithmetic::kInteger. An
// attention row holds for a group of ticks, so each layer's trace repeats it, as well as the gates,
// at each of them. Thread-safe.
void ComputeIntegerReference(const Policy& policy, const PrefixContext& prefix,
                             Engine::Output* output, Trace* trace);

}  // namespace spikeserve
