// Norms that become affine maps during training: x <- p LayerNorm(x) + (1 - p) BatchNorm(x), times
// a weight, plus a bias, with p falling from 1 to 0. FoldNorms (torch_model.cc) removes what is
// left.
//
// Not thread-safe while the moments change.
#pragma once

#include <torch/types.h>

#include <map>
#include <string>

#include "core/model/policy.h"
#include "train/model/parameters.h"

namespace spikeserve {

// Mean and variance of each element of a norm's input, [d], without a gradient.
struct NormMoments {
  torch::Tensor mean;
  torch::Tensor variance;
};

// The moments of one batch, by the name of the norm.
struct BatchMoments {
  torch::Tensor mask;  // [B, n]: 1 for timesteps of an episode, 0 for padding
  std::map<std::string, NormMoments> by_norm = {};  // Normalize adds to it
};

class FadingNorms {
 public:
  // The norms of `policy`, with p = 1. REQUIRES: a policy with norms and spikes.
  FadingNorms(const Policy& policy, torch::Device device);

  // Sets p, 0 to 1.
  void set_share(double share) { share_ = share; }

  // Returns the norm `name` of x [B, tokens, d], whose tokens are those of n timesteps, or only
  // their state tokens. In training, with moments of the batch, which are added to `batch`; with
  // the running ones if it is null.
  torch::Tensor Normalize(const Parameters& parameters, const torch::Tensor& x,
                          const std::string& name, BatchMoments* batch) const;

  // Moves the running moments a tenth of the way to those of a batch.
  void Follow(const BatchMoments& batch);

  // Sets the weights and biases of the norms of `policy`, which are those of the parameters, to the
  // affine maps that the norms are with p = 0.
  void MakeAffine(Policy* policy) const;

  // Returns the running moments by name, `NORM.mean` and `NORM.variance`.
  std::map<std::string, torch::Tensor> tensors() const;

 private:
  double share_ = 1.0;
  std::map<std::string, NormMoments> running_;
};

}  // namespace spikeserve
