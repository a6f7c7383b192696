// A dense decision transformer in libtorch with a cache of keys and values, as a careful PyTorch
// user would serve it.
//
// Measures the steady state: the window is always full, at first of zeros. Once the zeros have left
// the attention band, its answers equal those of the engine in dense mode. Not thread-safe.
#pragma once

#include <ATen/native/quantized/PackedParams.h>
#include <torch/types.h>

#include <map>
#include <string>
#include <vector>

#include "core/model/policy.h"
#include "train/model/parameters.h"

namespace spikeserve {

class CachedDense {
 public:
  // With `int8`, linear layers have 8-bit weights and round their inputs to 8 bits, as PyTorch's
  // dynamic quantisation does. REQUIRES: a valid policy of dense mode.
  CachedDense(const Policy& policy, bool int8);

  // Returns the logits [1, act] of timestep `timestep` from its three new tokens: a_{t-1} [1, act],
  // encoded by ActionSpace::Encode, and G_t [1, 1] and s_t [1, obs] in environment units. REQUIRES:
  // called for timesteps 0, 1, 2 and so on.
  torch::Tensor Decide(int64_t timestep, const torch::Tensor& action,
                       const torch::Tensor& return_to_go, const torch::Tensor& observation);

 private:
  struct Cache {
    torch::Tensor keys;    // [H, 3N - 1, d_h]
    torch::Tensor values;  // likewise
  };

  torch::Tensor Linear(const torch::Tensor& x, const std::string& name) const;
  torch::Tensor Embed(const char* modality, const torch::Tensor& input, int64_t timestep) const;
  torch::Tensor Heads(const torch::Tensor& x) const;  // [H, tokens, d_h]
  torch::Tensor Layer(const torch::Tensor& x, int layer);

  const Policy policy_;
  const Parameters p_;
  std::map<std::string, c10::intrusive_ptr<LinearPackedParamsBase>> packed_;  // empty: float32
  const torch::Tensor mask_;                                                  // [3, 3N + 2]
  std::vector<Cache> caches_;
};

}  // namespace spikeserve
