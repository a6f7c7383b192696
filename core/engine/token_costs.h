// Counts the operations of a token that depend only on the model's sizes, not on its activity:
// membrane updates, coder gains, LayerNorm, softmax and gate products.
#ifndef CORE_ENGINE_TOKEN_COSTS_H_
#define CORE_ENGINE_TOKEN_COSTS_H_

#include "core/engine/counts.h"
#include "core/engine/token.h"
#include "core/model/config.h"

namespace spikeserve {

// Adds the operations of one token of a spiking policy to `counts`. `keys` is the number of tokens
// that it may attend to, itself included. A state token includes the readout. Pure, thread-safe,
// and without loops, so that counting costs an engine nothing.
void AddTokenCosts(const ModelConfig& config, TokenKind kind, int keys, Counts* counts);

}  // namespace spikeserve

#endif  // CORE_ENGINE_TOKEN_COSTS_H_
