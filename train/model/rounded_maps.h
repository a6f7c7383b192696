// The populations of a model in integer arithmetic, for training.
//
// The forward pass computes with the integers of a rounded policy (core/quantize), as float32
// numbers. No sum leaves the integers that float32 holds exactly, so its order does not matter, and
// the results are those of the engines. The backward pass takes the rounding for the identity
// ("straight through": Y. Bengio, N. Leonard, A. Courville, arXiv:1308.3432, 2013): a weight w = s
// w_int with the scale s has the gradient (dL/dw_int) / s.
//
// Symbols as in torch_model.h. Not thread-safe.
#pragma once

#include <torch/types.h>

#include <map>
#include <string>

#include "core/model/policy.h"
#include "train/model/parameters.h"

namespace spikeserve {

class RoundedMaps {
 public:
  // Copies the integers of `rounded`, a policy in kInteger that was rounded from the current
  // values of the parameters below.
  explicit RoundedMaps(const Policy& rounded);

  // Returns the current into each neuron of the population `name` ("layers.0.attention.query") for
  // spikes [..., in], in units of the neuron's scale: [..., out].
  torch::Tensor Current(const Parameters& parameters, const std::string& name,
                        const torch::Tensor& spikes) const;

  // Return a population's thresholds and biases, in units of the scale, and its scales: [out].
  const torch::Tensor& threshold(const std::string& name) const;
  const torch::Tensor& bias(const std::string& name) const;
  const torch::Tensor& scale(const std::string& name) const;

 private:
  // Returns the integers of `name`, with the gradient passed through to the parameter of that name.
  // `scale` is broadcast to its shape.
  torch::Tensor Through(const Parameters& parameters, const std::string& name,
                        const torch::Tensor& scale) const;

  std::map<std::string, torch::Tensor> tensors_;
};

}  // namespace spikeserve
