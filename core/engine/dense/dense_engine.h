// Computes `dense` mode: an ordinary decision transformer (Chen et al., 2021) of the same size, for
// comparison.
//
// Tokens, attention band and residual structure are those of the SNN-DT. A learned timestep
// embedding is added before the LayerNorm of each modality, attention is softmax(q k / sqrt(d_h)) v
// over analog vectors, heads are concatenated, and the FFN is a GELU (tanh form; Hendrycks &
// Gimpel, 2016). Every product is a multiply-accumulate.
// Policies are in float32 or in integer arithmetic (integer_dense_pass.h).
//
// All engines and functions are thread-safe.
#pragma once

#include <memory>

#include "core/engine/engine.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

// Creates an engine that recomputes every token of the episode at every decision. REQUIRES: a valid
// policy of dense mode.
std::unique_ptr<Engine> MakeDenseReferenceEngine(std::shared_ptr<const Policy> policy);

// Creates an engine that stores the keys and values of the last N timesteps and computes only the
// new tokens. REQUIRES: a valid policy of dense mode.
std::unique_ptr<Engine> MakeDenseStreamingEngine(std::shared_ptr<const Policy> policy);

// Computes the decision at the last token of `prefix`, a state token. Records its attention in
// `trace` unless `trace` is null; trace->layers must have L elements. Thread-safe.
void ComputeDenseReference(const Policy& policy, const PrefixContext& prefix,
                           Engine::Output* output, Trace* trace);

}  // namespace spikeserve
