// The weights of a policy as torch tensors, by their names in the policy file.
#pragma once

#include <torch/types.h>

#include <cstdint>
#include <map>
#include <string>

#include "core/model/policy.h"
#include "train/model/patch_embedding.h"

namespace spikeserve {

// Returns copies of all tensors of a policy as float32, by name. Integers keep their values.
std::map<std::string, torch::Tensor> CopyTensors(const Policy& policy);

// Not thread-safe while the tensors are modified.
class Parameters {
 public:
  // Copies the policy's weights. All tensors require a gradient except `observation.*`, which are
  // computed from the data and not trained. With patches, random maps `patch.embedding` and
  // `patch.mix` replace `embed.state.weight`, which is their product. REQUIRES: the policy is
  // float32, and `patches` are not used or valid for it. The tensors are on `device`.
  Parameters(const Policy& policy, const PatchShape& patches, uint64_t seed,
             torch::Device device = torch::kCPU);
  // As above, without patches.
  explicit Parameters(const Policy& policy) : Parameters(policy, PatchShape(), /*seed=*/0) {}

  // REQUIRES: a tensor of that name exists.
  const torch::Tensor& operator[](const std::string& name) const { return tensors_.at(name); }

  // Returns W x + b with the tensors `name`.weight and `name`.bias.
  torch::Tensor Linear(const torch::Tensor& x, const std::string& name) const;

  // Returns LayerNorm(x) over the last dimension with the tensors `name`.weight and `name`.bias and
  // the epsilon of core (kLayerNormEpsilon).
  torch::Tensor Norm(const torch::Tensor& x, const std::string& name) const;

  // Returns all trained tensors by name, in alphabetical order.
  const std::map<std::string, torch::Tensor>& tensors() const { return tensors_; }

  // Writes the current values into `policy`, with the product of the patch maps. REQUIRES: `policy`
  // has the shapes of the policy that this object was created from.
  void Store(Policy* policy) const;

 private:
  // Returns a tensor of the policy file, which may be a function of trained tensors.
  torch::Tensor Exported(const std::string& name) const;

  const PatchShape patches_;
  std::map<std::string, torch::Tensor> tensors_;
};

}  // namespace spikeserve
