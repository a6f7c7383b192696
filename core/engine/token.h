// The tokens of an episode.
#ifndef CORE_ENGINE_TOKEN_H_
#define CORE_ENGINE_TOKEN_H_

#include <cstdint>
#include <vector>

#include "core/model/policy.h"

namespace spikeserve {

// The three tokens of a timestep, in the order in which they stand.
enum class TokenKind { kReturn, kState, kAction };
inline constexpr int kTokensPerTimestep = 3;

struct Token {
  TokenKind kind = TokenKind::kReturn;
  int64_t timestep = 0;
  std::vector<float> input;  // [1], [obs] or [act]: what the embedding takes, already standardised
};

inline const Embedding& EmbeddingOf(const Weights& weights, TokenKind kind) {
  switch (kind) {
    case TokenKind::kReturn:
      return weights.embed_return;
    case TokenKind::kState:
      return weights.embed_state;
    case TokenKind::kAction:
      break;
  }
  return weights.embed_action;
}

// (G - offset) / scale.
inline float StandardizeReturn(const Policy& policy, float return_to_go) {
  return (return_to_go - policy.return_offset) / policy.return_scale;
}

// (observation[i] - mean[i]) / std[i].
inline float StandardizeObservation(const Policy& policy, float value, int i) {
  return (value - policy.weights.observation_mean.values[i]) /
         policy.weights.observation_std.values[i];
}

}  // namespace spikeserve

#endif  // CORE_ENGINE_TOKEN_H_
