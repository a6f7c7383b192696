// One decision from the inside: every spike that it paid for, its attention and its routing gates.
//
// Plain values, recorded by the reference engines on request; the engine that serves knows nothing
// of them. Symbols: T ticks, H heads, L layers, N timesteps of context, t the decision's timestep.
#ifndef CORE_ENGINE_TRACE_H_
#define CORE_ENGINE_TRACE_H_

#include <cstdint>
#include <vector>

#include "core/engine/counts.h"
#include "core/engine/token.h"

namespace spikeserve {

// Spikes of a population over the ticks of one token: [T][neurons] of 0 and 1.
using SpikeTrain = std::vector<std::vector<uint8_t>>;

struct TokenName {
  TokenKind kind = TokenKind::kReturn;
  int64_t timestep = 0;

  friend bool operator==(const TokenName&, const TokenName&) = default;
};

inline constexpr int kNoLayer = -1;

// What one population emitted for one of the tokens a_{t-1}, G_t and s_t. Phase spikes are those of
// timestep t, which its tokens share; they stand with the token s_t.
struct PopulationTrace {
  Stage stage = Stage::kCoder;
  int layer = kNoLayer;  // [0, L); kNoLayer for phase and readout
  TokenName token;
  SpikeTrain spikes;
};

struct LayerTrace {
  // Attention of the token s_t: [T, H, keys] row-major, adding up to 1 over the keys. In dense mode
  // there are no ticks, and T is 1.
  std::vector<TokenName> keys;
  std::vector<float> attention;
  // Routing gates, [gated, T, H] row-major, of every token on which the decision depends through
  // this layer's output: the window in the first of two layers, s_t alone in the last. Empty
  // without routing. Eq. 4.8 to 4.10.
  std::vector<TokenName> gated;
  std::vector<float> gates;
};

struct Trace {
  std::vector<PopulationTrace> populations;  // by layer as computed; empty in dense mode
  std::vector<LayerTrace> layers;            // [L]
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_TRACE_H_
