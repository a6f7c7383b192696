#include "lab/bench/cached_dense.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/torch.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"

namespace spikeserve {
namespace {

using torch::indexing::None;
using torch::indexing::Slice;

constexpr int kNew = 3;  // new tokens per decision
constexpr double kUnseen = -1e9;

// Returns the attention mask of the new tokens, [3, 3N + 2]: each may attend to the tokens of the
// last N timesteps up to itself.
torch::Tensor Band(int context) {
  const int keys = 3 * context + 2;
  torch::Tensor mask = torch::zeros({kNew, keys});
  for (int token = 0; token < kNew; ++token) {
    mask.index_put_({token, Slice(keys - kNew + token + 1, None)}, kUnseen);
  }
  // Only a_{t-1} may attend to timestep t - N.
  mask.index_put_({Slice(1, None), Slice(None, 3)}, kUnseen);
  return mask;
}

// Returns `cache` followed by `fresh`, and drops the oldest tokens from `cache`.
torch::Tensor AppendToCache(const torch::Tensor& fresh, torch::Tensor& cache) {
  const torch::Tensor window = torch::cat({cache, fresh}, 1);
  cache = window.slice(1, kNew);
  return window;
}

using Packed = c10::intrusive_ptr<LinearPackedParamsBase>;

// Returns the linear layers with weights that are rounded to 8 bits, by their names.
std::map<std::string, Packed> PackLinear(const Parameters& parameters) {
  // The faster one, by far, of the two that Debian's libtorch has; oneDNN is the other.
  at::globalContext().setQEngine(at::QEngine::QNNPACK);
  const auto pack = c10::Dispatcher::singleton()
                        .findSchemaOrThrow("quantized::linear_prepack", "")
                        .typed<Packed(torch::Tensor, c10::optional<torch::Tensor>)>();
  std::map<std::string, Packed> packed;
  for (const auto& [name, weight] : parameters.tensors()) {
    const std::string bias = absl::StrCat(absl::StripSuffix(name, ".weight"), ".bias");
    if (weight.dim() != 2 || !parameters.tensors().contains(bias)) continue;
    const double scale = weight.abs().max().item<double>() / 127.0;
    const torch::Tensor rounded =
        torch::quantize_per_tensor(weight.detach(), scale, /*zero_point=*/0, torch::kQInt8);
    packed[std::string(absl::StripSuffix(name, ".weight"))] =
        pack.call(rounded, parameters[bias].detach());
  }
  return packed;
}

}  // namespace

CachedDense::CachedDense(const Policy& policy, bool int8)
    : policy_(policy), p_(policy), mask_(Band(policy.config.context)) {
  if (int8) packed_ = PackLinear(p_);
  const ModelConfig& config = policy_.config;
  for (int layer = 0; layer < config.layers; ++layer) {
    const auto zeros = [&config] {
      return torch::zeros({config.heads, 3 * config.context - 1, config.head_size()});
    };
    caches_.push_back({zeros(), zeros()});
  }
}

torch::Tensor CachedDense::Decide(int64_t timestep, const torch::Tensor& action,
                                  const torch::Tensor& return_to_go,
                                  const torch::Tensor& observation) {
  const torch::Tensor g = (return_to_go - policy_.return_offset) / policy_.return_scale;
  const torch::Tensor s = (observation - p_["observation.mean"]) / p_["observation.std"];
  torch::Tensor x = torch::cat({Embed("action", action, std::max<int64_t>(timestep - 1, 0)),
                                Embed("return", g, timestep), Embed("state", s, timestep)});
  for (int layer = 0; layer < policy_.config.layers; ++layer) x = Layer(x, layer);
  return Linear(x, "head");
}

torch::Tensor CachedDense::Linear(const torch::Tensor& x, const std::string& name) const {
  return packed_.empty() ? p_.Linear(x, name) : packed_.at(name)->apply_dynamic(x);
}

torch::Tensor CachedDense::Embed(const char* modality, const torch::Tensor& input,
                                 int64_t timestep) const {
  const std::string name = absl::StrCat("embed.", modality);
  const torch::Tensor& table = p_["embed.timestep.weight"];
  const int64_t row = std::min<int64_t>(timestep, table.size(0) - 1);
  return p_.Norm(Linear(input, name) + table[row], name + ".norm");
}

torch::Tensor CachedDense::Heads(const torch::Tensor& x) const {
  return x.view({x.size(0), policy_.config.heads, policy_.config.head_size()}).transpose(0, 1);
}

torch::Tensor CachedDense::Layer(const torch::Tensor& x, int layer) {
  const std::string name = absl::StrCat("layers.", layer);
  const std::string attention = name + ".attention";
  const bool is_last = layer + 1 == policy_.config.layers;
  const torch::Tensor asking = is_last ? x.slice(0, kNew - 1) : x;
  const torch::Tensor mask = is_last ? mask_.slice(0, kNew - 1) : mask_;
  const torch::Tensor query = Heads(Linear(asking, attention + ".query"));
  const torch::Tensor keys =
      AppendToCache(Heads(Linear(x, attention + ".key")), caches_[layer].keys);
  const torch::Tensor values =
      AppendToCache(Heads(Linear(x, attention + ".value")), caches_[layer].values);
  const torch::Tensor scores =
      torch::matmul(query, keys.transpose(1, 2)) / std::sqrt(policy_.config.head_size()) + mask;
  const torch::Tensor y = torch::matmul(torch::softmax(scores, -1), values).transpose(0, 1);
  const torch::Tensor after =
      p_.Norm(asking + Linear(y.flatten(1), attention + ".output"), attention + ".norm");
  const torch::Tensor hidden = at::gelu(Linear(after, name + ".ffn.hidden"), "tanh");
  return p_.Norm(after + Linear(hidden, name + ".ffn.output"), name + ".ffn.norm");
}

}  // namespace spikeserve
