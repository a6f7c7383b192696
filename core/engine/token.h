// Defines the tokens of an episode and their inputs.
//
// All functions are pure and thread-safe.
#pragma once

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
  // [1], [config.state_inputs(obs)] or [act]: input of the embedding, already standardised
  std::vector<float> input;
};

// Returns the embedding of tokens of this kind, from weights in any form.
const auto& EmbeddingOf(const auto& weights, TokenKind kind) {
  return kind == TokenKind::kReturn  ? weights.embed_return
         : kind == TokenKind::kState ? weights.embed_state
                                     : weights.embed_action;
}

// Returns (return_to_go - offset) / scale.
inline float StandardizeReturn(const Policy& policy, float return_to_go) {
  return (return_to_go - policy.return_offset) / policy.return_scale;
}

// Sets `input` to that of the state token for observation o_t:
//
//   input[i] = (o_t[i] - mean[i]) / std[i]                      i < obs
//   input[obs + i] = (o_t[i] - o_{t-1}[i]) / change_std[i]      with config.observation_changes
//
// `previous` is o_{t-1}; empty: there is none, and the changes are 0. It becomes o_t, or stays
// empty without changes.
inline void SetStateInput(const Policy& policy, absl::Span<const float> observation,
                          std::vector<float>* previous, std::vector<float>* input) {
  const size_t size = observation.size();
  const Weights& weights = policy.weights;
  input->assign(policy.config.state_inputs(static_cast<int>(size)), 0.0f);
  for (size_t i = 0; i < size; ++i) {
    (*input)[i] =
        (observation[i] - weights.observation_mean.values[i]) / weights.observation_std.values[i];
  }
  if (!policy.config.observation_changes) return;
  for (size_t i = 0; i < previous->size(); ++i) {
    (*input)[size + i] =
        (observation[i] - (*previous)[i]) / weights.observation_change_std.values[i];
  }
  previous->assign(observation.begin(), observation.end());
}

inline Token ReturnToken(const Policy& policy, int64_t timestep, float return_to_go) {
  return {TokenKind::kReturn, timestep, {StandardizeReturn(policy, return_to_go)}};
}

// `previous` as in SetStateInput.
inline Token StateToken(const Policy& policy, int64_t timestep, absl::Span<const float> observation,
                        std::vector<float>* previous) {
  Token token = {TokenKind::kState, timestep, {}};
  SetStateInput(policy, observation, previous, &token.input);
  return token;
}

inline Token ActionToken(int64_t timestep, absl::Span<const float> encoded_action) {
  return {TokenKind::kAction, timestep, {encoded_action.begin(), encoded_action.end()}};
}

}  // namespace spikeserve
