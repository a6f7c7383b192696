// Defines the tokens of an episode and their inputs.
//
// All functions are pure and thread-safe.
#ifndef CORE_ENGINE_TOKEN_H_
#define CORE_ENGINE_TOKEN_H_

#include <cstdint>
#include <vector>

#include "absl/types/span.h"
#include "core/model/policy.h"

namespace spikeserve {

// The three tokens of a timestep, in the order of the sequence.
enum class TokenKind { kReturn, kState, kAction };
inline constexpr int kTokensPerTimestep = 3;

// One element of the model's input sequence.
struct Token {
  TokenKind kind = TokenKind::kReturn;
  int64_t timestep = 0;
  std::vector<float> input;  // [1], [obs] or [act]: input of the embedding, already standardised
};

// Returns the embedding of tokens of this kind.
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

// Returns (return_to_go - offset) / scale.
inline float StandardizeReturn(const Policy& policy, float return_to_go) {
  return (return_to_go - policy.return_offset) / policy.return_scale;
}

// Sets input[i] = (observation[i] - mean[i]) / std[i].
inline void StandardizeObservation(const Policy& policy, absl::Span<const float> observation,
                                   std::vector<float>* input) {
  input->resize(observation.size());
  for (size_t i = 0; i < observation.size(); ++i) {
    (*input)[i] = (observation[i] - policy.weights.observation_mean.values[i]) /
                  policy.weights.observation_std.values[i];
  }
}

inline Token ReturnToken(const Policy& policy, int64_t timestep, float return_to_go) {
  return {TokenKind::kReturn, timestep, {StandardizeReturn(policy, return_to_go)}};
}

inline Token StateToken(const Policy& policy, int64_t timestep,
                        absl::Span<const float> observation) {
  Token token = {TokenKind::kState, timestep, {}};
  StandardizeObservation(policy, observation, &token.input);
  return token;
}

inline Token ActionToken(int64_t timestep, absl::Span<const float> encoded_action) {
  return {TokenKind::kAction, timestep, {encoded_action.begin(), encoded_action.end()}};
}

}  // namespace spikeserve

#endif  // CORE_ENGINE_TOKEN_H_
