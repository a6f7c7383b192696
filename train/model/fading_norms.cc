#include "train/model/fading_norms.h"

#include <ATen/ops/layer_norm.h>
#include <ATen/ops/rsqrt.h>

#include <cmath>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "core/math/layer_norm.h"

namespace spikeserve {
namespace {

constexpr double kMomentum = 0.1;  // of the running moments

// Calls `visit` with the name and the parameters of every norm.
template <class AnyPolicy, class Visitor>
void VisitNorms(AnyPolicy& policy, const Visitor& visit) {
  auto& weights = policy.weights;
  visit("embed.return.norm", weights.embed_return.norm);
  visit("embed.state.norm", weights.embed_state.norm);
  visit("embed.action.norm", weights.embed_action.norm);
  for (size_t i = 0; i < weights.layers.size(); ++i) {
    visit(absl::StrCat("layers.", i, ".attention.norm"), weights.layers[i].attention_norm);
    visit(absl::StrCat("layers.", i, ".ffn.norm"), weights.layers[i].ffn_norm);
  }
}

// Returns the moments of x [B, tokens, d] over the tokens of the timesteps in `mask` [B, n].
NormMoments MomentsOf(const torch::Tensor& x, const torch::Tensor& mask) {
  torch::Tensor weight = mask;
  if (x.size(1) != mask.size(1)) {
    weight = mask.repeat_interleave(x.size(1) / mask.size(1), 1);
  }
  weight = (weight / weight.sum()).unsqueeze(-1);
  const std::vector<int64_t> tokens = {0, 1};
  const torch::Tensor mean = (x * weight).sum(tokens);
  return {mean, ((x - mean).square() * weight).sum(tokens)};
}

}  // namespace

FadingNorms::FadingNorms(const Policy& policy, torch::Device device) {
  SPIKESERVE_DCHECK(!policy.config.is_dense());
  const auto options = torch::TensorOptions().dtype(torch::kFloat).device(device);
  VisitNorms(policy, [&](const std::string& name, const Norm&) {
    const int64_t d = policy.config.hidden_size;
    running_[name] = {torch::zeros({d}, options), torch::ones({d}, options)};
  });
}

torch::Tensor FadingNorms::Normalize(const Parameters& parameters, const torch::Tensor& x,
                                     const std::string& name, BatchMoments* batch) const {
  NormMoments moments = running_.at(name);
  if (batch != nullptr) {
    moments = MomentsOf(x, batch->mask);
    batch->by_norm[name] = {moments.mean.detach(), moments.variance.detach()};
  }
  torch::Tensor y = (x - moments.mean) * torch::rsqrt(moments.variance + kLayerNormEpsilon);
  if (share_ > 0.0) {
    y = y * (1.0 - share_) + share_ * at::layer_norm(x, {x.size(-1)}, {}, {}, kLayerNormEpsilon);
  }
  return y * parameters[name + ".weight"] + parameters[name + ".bias"];
}

void FadingNorms::Follow(const BatchMoments& batch) {
  const torch::NoGradGuard no_gradient;
  for (const auto& [name, moments] : batch.by_norm) {
    NormMoments& running = running_.at(name);
    running.mean.lerp_(moments.mean, kMomentum);
    running.variance.lerp_(moments.variance, kMomentum);
  }
}

void FadingNorms::MakeAffine(Policy* policy) const {
  SPIKESERVE_DCHECK(share_ == 0.0);
  VisitNorms(*policy, [&](const std::string& name, Norm& norm) {
    const NormMoments& moments = running_.at(name);
    const torch::Tensor mean = moments.mean.cpu(), variance = moments.variance.cpu();
    for (size_t k = 0; k < norm.weight.values.size(); ++k) {
      const auto i = static_cast<int64_t>(k);
      const double weight =
          norm.weight.values[k] / std::sqrt(variance[i].item<double>() + double{kLayerNormEpsilon});
      norm.weight.values[k] = static_cast<float>(weight);
      norm.bias.values[k] =
          static_cast<float>(norm.bias.values[k] - mean[i].item<double>() * weight);
    }
  });
}

std::map<std::string, torch::Tensor> FadingNorms::tensors() const {
  std::map<std::string, torch::Tensor> tensors;
  for (const auto& [name, moments] : running_) {
    tensors.emplace(name + ".mean", moments.mean);
    tensors.emplace(name + ".variance", moments.variance);
  }
  return tensors;
}

}  // namespace spikeserve
