// The SNN-DT on torch tensors, for training: model.md's equations with surrogate gradients.
//
// Not thread-safe. Symbols: B clips, n timesteps of a clip, d hidden size, obs and act as in core.
#ifndef TRAIN_MODEL_TORCH_MODEL_H_
#define TRAIN_MODEL_TORCH_MODEL_H_

#include <torch/types.h>

#include <vector>

#include "core/engine/counts.h"
#include "core/model/policy.h"
#include "train/model/parameters.h"
#include "train/model/surrogate.h"

namespace spikeserve {

// Clips of episodes, each a run of n timesteps. Whatever stands after an episode's end is causally
// invisible.
struct ClipTensors {
  torch::Tensor return_to_go;  // [B, n], environment units
  torch::Tensor observations;  // [B, n, obs], environment units
  torch::Tensor actions;       // [B, n, act], as ActionSpace::Encode writes them
  torch::Tensor timesteps;     // [B, n], int64, within the episode
  torch::Tensor seeds;         // [B], int64; keys of the Bernoulli coder
};

// One population's activity. Tokens run over all 3n tokens of a clip (return, state, action,
// return, ...), or over its n state tokens where only those are computed.
struct Population {
  Stage stage;
  int layer;             // -1: readout and phase
  torch::Tensor spikes;  // [T, B, tokens, neurons]; phase: [T, B, n, H]
  // Into LIF neurons: shaped as spikes, or [B, tokens, neurons] where constant. Undefined
  // otherwise.
  torch::Tensor current;
};

struct ModelOutput {
  torch::Tensor logits;                 // [B, n, act], z at the state tokens
  torch::Tensor readout;                // [B, n, d]
  std::vector<Population> populations;  // in the order of computation
};

class TorchModel {
 public:
  // Starts from the policy's weights. REQUIRES: a valid policy.
  TorchModel(Policy policy, const Surrogate& surrogate);

  ModelOutput Forward(const ClipTensors& clips) const;

  const Parameters& parameters() const { return parameters_; }

  // The policy with the present weights.
  Policy CurrentPolicy() const;

 private:
  const Policy policy_;
  const Surrogate surrogate_;
  const Parameters parameters_;
};

}  // namespace spikeserve

#endif  // TRAIN_MODEL_TORCH_MODEL_H_
