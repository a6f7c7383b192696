// The SNN-DT on torch tensors, for training: computes the equations of the reference engine
// (core/engine/reference) with surrogate gradients.
//
// Not thread-safe. Symbols: B clips, n timesteps per clip, d hidden size, T ticks, H heads, obs
// length of an observation, act outputs of the action head.
#ifndef TRAIN_MODEL_TORCH_MODEL_H_
#define TRAIN_MODEL_TORCH_MODEL_H_

#include <torch/types.h>

#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "core/engine/counts.h"
#include "core/model/policy.h"
#include "train/model/parameters.h"
#include "train/model/rounded_maps.h"
#include "train/model/surrogate.h"

namespace spikeserve {

// A batch of clips, each a run of n timesteps of an episode. Values after the end of an episode do
// not influence its steps, because attention is causal.
struct ClipTensors {
  torch::Tensor return_to_go;  // [B, n], environment units
  torch::Tensor observations;  // [B, n, obs], environment units
  torch::Tensor actions;       // [B, n, act], encoded by ActionSpace::Encode
  torch::Tensor timesteps;     // [B, n], int64, counted from the start of the episode
  torch::Tensor seeds;         // [B], int64, keys of the Bernoulli coder
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

class TorchModel {
 public:
  // Copies the policy's weights as initial parameters. With kInt8, runs the policy as Quantize()
  // rounds it. With patches, the state embedding starts from random patch maps that are drawn from
  // `seed`. REQUIRES: a valid policy in float32, and with kInt8 one that Quantize() accepts;
  // patches that are not used or valid for it.
  TorchModel(Policy policy, const Surrogate& surrogate,
             Arithmetic arithmetic = Arithmetic::kFloat32, const PatchShape& patches = {},
             uint64_t seed = 0);

  // Runs the model on all clips; records the autograd graph unless gradients are disabled. With
  // kInt8, computes with the weights of the last Round(), or else of the initial policy.
  ModelOutput Forward(const ClipTensors& clips) const;

  const Parameters& parameters() const { return parameters_; }

  // Rounds the current parameters; call it after every change of them. Returns INVALID_ARGUMENT,
  // which names the tensor, if 16 bits cannot hold a bias or a current. Does nothing with kFloat32.
  absl::Status Round();

  // Returns the policy with the current weights; with kInt8, with the integers of the last Round().
  Policy CurrentPolicy() const;

 private:
  // The integer policy, and its maps as tensors.
  struct Rounded {
    Policy policy;
    RoundedMaps maps;
  };

  Policy FloatPolicy() const;
  void SetRounded(Policy policy);

  const Policy policy_;
  const Surrogate surrogate_;
  const Parameters parameters_;
  const Arithmetic arithmetic_;
  std::optional<Rounded> rounded_;  // with kInt8
};

}  // namespace spikeserve

#endif  // TRAIN_MODEL_TORCH_MODEL_H_
