// What a model reads and returns in training, as torch tensors.
//
// Symbols: B clips, n timesteps per clip, d hidden size, T ticks, H heads, obs length of an
// observation, act outputs of the action head. All functions are pure.
#pragma once

#include <torch/types.h>

#include <vector>

#include "core/engine/counts.h"
#include "core/model/policy.h"
#include "train/model/parameters.h"

namespace spikeserve {

// A batch of clips, each a run of n timesteps of an episode. Values after the end of an episode do
// not influence its steps, because attention is causal.
struct ClipTensors {
  torch::Tensor return_to_go;  // [B, n], environment units
  torch::Tensor observations;  // [B, n, obs], environment units
  torch::Tensor actions;       // [B, n, act], encoded by ActionSpace::Encode
  torch::Tensor timesteps;     // [B, n], int64, counted from the start of the episode
  // [B, obs]: the observation before the first one of the clip; at the start of an episode, the
  // first one itself. Read only with config.observation_changes.
  torch::Tensor previous;
};

// The activity of one population. The token dimension holds all 3n tokens of a clip (return, state,
// action, return, ...), or only its n state tokens where the others are not computed.
struct Population {
  Stage stage;
  int layer;             // -1 for readout and phase, which belong to no layer
  torch::Tensor spikes;  // [T, B, tokens, neurons]; of phase: [T, B, n, H]
  // Input current of float32 LIF neurons: the shape of `spikes`, or [B, tokens, neurons] if it is
  // constant over the ticks. Undefined for other neurons.
  torch::Tensor current;
};

struct ModelOutput {
  torch::Tensor logits;                 // [B, n, act], z of the state tokens
  torch::Tensor readout;                // [B, n, d]
  std::vector<Population> populations;  // in the order of computation
};

// Tokens per timestep, in this order: return-to-go, state, action.
inline constexpr int kTokens = 3;

// Returns the state tokens: every third token along `dimension`, starting with the second.
torch::Tensor StateTokens(const torch::Tensor& x, int64_t dimension);

// Returns a tensor with one entry for each of the `times` tokens of a timestep along `dimension`,
// which has one for each timestep.
torch::Tensor ForEachToken(const torch::Tensor& x, int64_t dimension, int64_t times = kTokens);

// Return the inputs of the return and state tokens (see SetStateInput): [B, n, 1] and [B, n, state
// inputs].
torch::Tensor ReturnInput(const Policy& policy, const ClipTensors& clips);
torch::Tensor StateInput(const Policy& policy, const Parameters& parameters,
                         const ClipTensors& clips);

// Returns the time tau of the phase generators: float64, which broadcasts to [T, B, n, 1].
torch::Tensor PhaseTimes(const ModelConfig& config, const torch::Tensor& timesteps);

}  // namespace spikeserve
