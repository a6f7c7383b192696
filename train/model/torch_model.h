// The SNN-DT on torch tensors, for training: computes the equations of the reference engine
// (core/engine/reference) with surrogate gradients.
//
// Not thread-safe. Symbols as in clip_tensors.h.
#pragma once

#include <optional>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/model/policy.h"
#include "train/model/clip_tensors.h"
#include "train/model/fading_norms.h"
#include "train/model/parameters.h"
#include "train/model/rounded_maps.h"
#include "train/neuron/surrogate.h"

namespace spikeserve {

// Returns the policy in another arithmetic, with the defaults of IntegerOptions for kInteger.
// INVALID_ARGUMENT, which names the tensor or field, if that arithmetic cannot hold it.
absl::StatusOr<Policy> RoundTo(Arithmetic arithmetic, const Policy& policy);

class TorchModel {
 public:
  // Copies the policy's weights as initial parameters. Runs the policy as RoundTo() rounds it. With
  // patches, the state embedding starts from random patch maps that are drawn from `seed`.
  // Computes on `device`, where the tensors of clips have to be. REQUIRES: a valid policy in
  // float32 that RoundTo() accepts; patches that are not used or valid for it; the processor, for
  // integers.
  TorchModel(Policy policy, const Surrogate& surrogate,
             Arithmetic arithmetic = Arithmetic::kFloat32, const PatchShape& patches = {},
             uint64_t seed = 0, torch::Device device = torch::kCPU);

  // Runs the model on all clips; records the autograd graph unless gradients are disabled. In
  // integers, computes with the weights of the last Round(), or else of the initial policy.
  ModelOutput Forward(const ClipTensors& clips) const;

  // Lets the norms fade, from p = 1 on. REQUIRES: a policy with norms and spikes, and kFloat32.
  void FadeNorms();
  // The norms that fade; null if they do not.
  FadingNorms* fading_norms() { return fading_norms_.has_value() ? &*fading_norms_ : nullptr; }
  const FadingNorms* fading_norms() const {
    return fading_norms_.has_value() ? &*fading_norms_ : nullptr;
  }

  // As Forward, for a training step on the timesteps of `mask` [B, n]: norms that fade take the
  // moments of the batch, which their running moments follow.
  ModelOutput ForwardInTraining(const ClipTensors& clips, const torch::Tensor& mask);

  const Parameters& parameters() const { return parameters_; }

  // Rounds the current parameters; call it after every change of them. Returns INVALID_ARGUMENT,
  // which names the tensor, if integers cannot hold a number. Does nothing with kFloat32.
  absl::Status Round();

  // Returns the policy with the current weights, or with the integers of the last Round(). Norms
  // that have faded are folded. REQUIRES: no norm that is still fading.
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
  std::optional<Rounded> rounded_;  // not with kFloat32
  std::optional<FadingNorms> fading_norms_;
};

}  // namespace spikeserve
