#include "train/model/parameters.h"

#include <ATen/ops/layer_norm.h>
#include <ATen/ops/linear.h>

#include <algorithm>
#include <variant>
#include <vector>

#include "absl/strings/match.h"
#include "core/contract/dcheck.h"
#include "core/math/layer_norm.h"

namespace spikeserve {
namespace {

constexpr char kStateWeight[] = "embed.state.weight";
constexpr char kPatchEmbedding[] = "patch.embedding";
constexpr char kPatchMix[] = "patch.mix";

std::vector<TensorSlot> Slots(Policy* policy) {
  return TensorSlots(policy->config, policy->observation_size(), policy->action_space.size(),
                     &policy->weights);
}

template <class Number>
torch::Tensor Copy(BasicTensor<Number>& tensor) {
  const std::vector<int64_t> shape(tensor.shape.begin(), tensor.shape.end());
  return torch::from_blob(tensor.values.data(), shape, torch::CppTypeToScalarType<Number>::value)
      .to(torch::kFloat, /*non_blocking=*/false, /*copy=*/true);
}

}  // namespace

std::map<std::string, torch::Tensor> CopyTensors(const Policy& policy) {
  Policy copy = policy;
  std::map<std::string, torch::Tensor> tensors;
  for (const TensorSlot& slot : Slots(&copy)) {
    tensors.emplace(slot.name, std::visit([](auto* tensor) { return Copy(*tensor); }, slot.tensor));
  }
  return tensors;
}

Parameters::Parameters(const Policy& policy, const PatchShape& patches, uint64_t seed,
                       torch::Device device)
    : patches_(patches), tensors_(CopyTensors(policy)) {
  SPIKESERVE_DCHECK(policy.config.arithmetic == Arithmetic::kFloat32);
  for (auto& [name, tensor] : tensors_) {
    tensor = tensor.to(device);
    tensor.set_requires_grad(!absl::StartsWith(name, "observation."));
  }
  if (!patches.used()) return;
  tensors_.erase(kStateWeight);
  const PatchMaps maps = RandomPatchMaps(patches, policy.config.hidden_size, seed);
  tensors_.emplace(kPatchEmbedding, maps.embedding.to(device).set_requires_grad(true));
  tensors_.emplace(kPatchMix, maps.mix.to(device).set_requires_grad(true));
}

torch::Tensor Parameters::Linear(const torch::Tensor& x, const std::string& name) const {
  return at::linear(x, Exported(name + ".weight"), tensors_.at(name + ".bias"));
}

torch::Tensor Parameters::Norm(const torch::Tensor& x, const std::string& name) const {
  return at::layer_norm(x, {x.size(-1)}, tensors_.at(name + ".weight"), tensors_.at(name + ".bias"),
                        kLayerNormEpsilon);
}

torch::Tensor Parameters::Exported(const std::string& name) const {
  if (!patches_.used() || name != kStateWeight) return tensors_.at(name);
  return FoldPatches(patches_, {tensors_.at(kPatchEmbedding), tensors_.at(kPatchMix)});
}

void Parameters::Store(Policy* policy) const {
  for (const TensorSlot& slot : Slots(policy)) {
    const torch::Tensor tensor = Exported(slot.name).detach().cpu().contiguous();
    SPIKESERVE_DCHECK_EQ(tensor.numel(), static_cast<int64_t>(slot.floats()->values.size()));
    std::copy_n(tensor.data_ptr<float>(), tensor.numel(), slot.floats()->values.begin());
  }
}

}  // namespace spikeserve
