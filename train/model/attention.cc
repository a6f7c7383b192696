#include "train/model/attention.h"

namespace spikeserve {
namespace {

// [..., S, d] -> [..., H, S, d_h]
torch::Tensor SplitHeads(const torch::Tensor& x, int heads) {
  std::vector<int64_t> shape = x.sizes().vec();
  shape.back() /= heads;
  shape.insert(shape.end() - 1, heads);
  return x.view(shape).transpose(-2, -3);
}

// Returns the gates [T, B, Q, H], or [1] if the policy has no routing and all gates are equal.
// `heads_by_token` is [T, B, Q, H, d_h].
torch::Tensor Gates(const Parameters& parameters, const std::string& layer,
                    const ModelConfig& config, const torch::Tensor& heads_by_token) {
  const bool side_by_side = config.merge == Merge::kConcat;
  if (!config.has_routing()) {
    return torch::full({1}, side_by_side ? 1.0 : 1.0 / config.heads, heads_by_token.options());
  }
  const torch::Tensor u = heads_by_token.flatten(-2);
  const torch::Tensor hidden = torch::relu(parameters.Linear(u, layer + ".routing.hidden"));
  const torch::Tensor g = parameters.Linear(hidden, layer + ".routing.gate");
  if (config.gate == Gate::kSigmoid) return torch::sigmoid(g);
  const torch::Tensor gates = torch::softmax(g, -1);
  return side_by_side ? gates * config.heads : gates;
}

}  // namespace

torch::Tensor BandMask(int64_t timesteps, int context, torch::Device device) {
  constexpr double kUnseen = -1e9;
  const torch::Tensor index = torch::arange(3 * timesteps, device);
  const torch::Tensor timestep = torch::div(index, 3, "floor");
  const torch::Tensor later = index.unsqueeze(0) > index.unsqueeze(1);
  const torch::Tensor forgotten = timestep.unsqueeze(0) <= timestep.unsqueeze(1) - context;
  return torch::zeros(later.sizes(), device).masked_fill(later | forgotten, kUnseen);
}

torch::Tensor Attend(const torch::Tensor& q, const torch::Tensor& k, const torch::Tensor& v,
                     const torch::Tensor& scale, const torch::Tensor& mask, int heads) {
  const torch::Tensor scaled = SplitHeads(q, heads) * scale.view({-1, 1, 1});
  const torch::Tensor scores = torch::matmul(scaled, SplitHeads(k, heads).transpose(-1, -2));
  return torch::matmul(torch::softmax(scores.add_(mask), -1), SplitHeads(v, heads));
}

torch::Tensor RouteHeads(const Parameters& parameters, const std::string& layer,
                         const ModelConfig& config, const torch::Tensor& y) {
  const torch::Tensor by_token = y.transpose(2, 3);
  const torch::Tensor gated = by_token * Gates(parameters, layer, config, by_token).unsqueeze(-1);
  if (config.merge == Merge::kConcat) return gated.mean(0).flatten(-2);
  return gated.sum(std::vector<int64_t>{0, 3}) / y.size(0);
}

}  // namespace spikeserve
