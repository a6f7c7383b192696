#include "train/model/parameters.h"

#include <ATen/ops/layer_norm.h>
#include <ATen/ops/linear.h>

#include <algorithm>

#include "absl/strings/match.h"
#include "core/math/layer_norm.h"

namespace spikeserve {
namespace {

std::vector<TensorSlot> Slots(Policy* policy) {
  return TensorSlots(policy->config, policy->observation_size(), policy->action_space.size(),
                     &policy->weights);
}

}  // namespace

Parameters::Parameters(const Policy& policy) {
  Policy copy = policy;
  for (const TensorSlot& slot : Slots(&copy)) {
    const std::vector<int64_t> shape(slot.floats()->shape.begin(), slot.floats()->shape.end());
    torch::Tensor tensor = torch::from_blob(slot.floats()->values.data(), shape).clone();
    tensor.set_requires_grad(!absl::StartsWith(slot.name, "observation."));
    tensors_.emplace(slot.name, tensor);
  }
}

torch::Tensor Parameters::Linear(const torch::Tensor& x, const std::string& name) const {
  return at::linear(x, tensors_.at(name + ".weight"), tensors_.at(name + ".bias"));
}

torch::Tensor Parameters::Norm(const torch::Tensor& x, const std::string& name) const {
  return at::layer_norm(x, {x.size(-1)}, tensors_.at(name + ".weight"), tensors_.at(name + ".bias"),
                        kLayerNormEpsilon);
}

void Parameters::Store(Policy* policy) const {
  for (const TensorSlot& slot : Slots(policy)) {
    const torch::Tensor tensor = tensors_.at(slot.name).detach().contiguous();
    std::copy_n(tensor.data_ptr<float>(), tensor.numel(), slot.floats()->values.begin());
  }
}

}  // namespace spikeserve
