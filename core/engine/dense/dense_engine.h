// `dense` mode: an ordinary decision transformer (Chen et al., 2021) of the same size, for
// comparison.
//
// Tokens, band and residual structure are the SNN-DT's; a learned timestep embedding is added
// before the modality's LayerNorm, attention is softmax(q k / sqrt(d_h)) v over analog vectors,
// heads stand side by side, and the FFN is a GELU (tanh form; Hendrycks & Gimpel, 2016). Every
// product is a multiply-accumulate. Thread-safety as in engine.h.
#ifndef CORE_ENGINE_DENSE_DENSE_ENGINE_H_
#define CORE_ENGINE_DENSE_DENSE_ENGINE_H_

#include <memory>

#include "core/engine/engine.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

// Recomputes every token of the episode at every decision.
// REQUIRES: a valid policy of dense mode.
std::unique_ptr<Engine> MakeDenseReferenceEngine(std::shared_ptr<const Policy> policy);

// Keeps keys and values of the last N timesteps and computes only the new tokens.
// REQUIRES: a valid policy of dense mode.
std::unique_ptr<Engine> MakeDenseStreamingEngine(std::shared_ptr<const Policy> policy);

// The decision at the last token of `prefix`, a state token; its attention is recorded in `trace`,
// unless null, whose `layers` has L elements. Thread-safe.
void ComputeDenseReference(const Policy& policy, const PrefixContext& prefix,
                           Engine::Output* output, Trace* trace);

}  // namespace spikeserve

#endif  // CORE_ENGINE_DENSE_DENSE_ENGINE_H_
