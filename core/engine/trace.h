// Records the inside of one decision: the spikes of its new tokens, its attention and its routing
// gates.
//
// Plain values. The reference engines record a trace on request; the streaming engine cannot.
// Symbols: T ticks, H heads, L layers, N timesteps of context, t the decision's timestep.
#pragma once

#include <cstdint>
#include <vector>

#include "core/engine/counts.h"
#include "core/engine/token.h"

namespace spikeserve {

// The spikes of a population over the ticks of one token: [T][neurons], each 0 or 1.
using SpikeTrain = std::vector<std::vector<uint8_t>>;

// Identifies a token of an episode.
struct TokenName {
  TokenKind kind = TokenKind::kReturn;
  int64_t timestep = 0;

  friend bool operator==(const TokenName&, const TokenName&) = default;
};

// The layer of a population that belongs to no layer.
inline constexpr int kNoLayer = -1;

// The spikes of one population for one of the tokens a_{t-1}, G_t and s_t. The phase spikes of
// timestep t, which its tokens share, are recorded with s_t.
struct PopulationTrace {
  Stage stage = Stage::kCoder;
  int layer = kNoLayer;  // [0, L); kNoLayer for phase and readout
  TokenName token;
  SpikeTrain spikes;
};

// Attention and routing of one layer.
struct LayerTrace {
  // Attention weights of the token s_t: [T, H, keys] row-major, which sum to 1 over the keys. In
  // dense mode there are no ticks, and T is 1.
  std::vector<TokenName> keys;
  std::vector<float> attention;
  // Routing gates (eq. 4.8 to 4.10), [gated, T, H] row-major, of every token whose output of this
  // layer the decision depends on. With two layers, these are the tokens of the last N timesteps in
  // the first layer, and only s_t in the last. Empty without routing.
  std::vector<TokenName> gated;
  std::vector<float> gates;
};

// The recording of one decision.
struct Trace {
  std::vector<PopulationTrace> populations;  // in the order of computation; empty in dense mode
  std::vector<LayerTrace> layers;            // [L]
};

}  // namespace spikeserve
