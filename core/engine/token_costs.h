// Counts the operations of a token that depend only on the model's sizes, not on its activity:
// membrane updates, coder gains, LayerNorm, softmax and gate products, and in integer arithmetic
// the weights that are read once for all new tokens.
#pragma once

#include <cstdint>

#include "core/engine/counts.h"
#include "core/engine/token.h"
#include "core/model/config.h"

namespace spikeserve {

// Adds the operations of one token of a spiking policy to `counts`. `keys` is the number of tokens
// that it may attend to, itself included. A state token includes the readout. Pure, thread-safe,
// and without loops, so that counting costs an engine nothing.
void AddTokenCosts(const ModelConfig& config, TokenKind kind, int keys, Counts* counts);

// Returns the bytes of the weights that a policy in integer arithmetic reads once for all new
// tokens of a decision, and that are due to this token: its embedding of `inputs` numbers, and for
// a state token the maps of every layer whose inputs are analog (in a dense policy all), and the
// head of `actions` outputs. Pure and thread-safe.
uint64_t SharedWeightBytes(const ModelConfig& config, TokenKind kind, int inputs, int actions);

// Return the bytes of the spikes of `neurons` neurons at `ticks` ticks, and of values in integer
// arithmetic: spikes, or one count a neuron if attention takes all ticks together.
uint64_t SpikeBytes(int ticks, int neurons);
uint64_t ValueBytes(const ModelConfig& config, int ticks, int neurons);

}  // namespace spikeserve
