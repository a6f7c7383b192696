#include "train/trainer/head_plasticity.h"

#include "core/contract/dcheck.h"
#include "core/learning/postsynaptic.h"

namespace spikeserve {
namespace {

// Returns y of eq. 4.1, [B, n, act].
torch::Tensor Postsynaptic(Rule rule, const ActionSpace& space, const torch::Tensor& logits,
                           const torch::Tensor& targets) {
  if (rule == Rule::kHebbianAction) return targets;
  const torch::Tensor answer =
      space.is_discrete() ? torch::softmax(logits, -1) : torch::tanh(logits);
  if (rule == Rule::kHebbian) return answer;
  if (space.is_discrete()) return targets - answer;
  return (torch::atanh(targets) - logits).clamp(-kLargestExecutedScore, kLargestExecutedScore);
}

// Returns [n, n] with lambda^(t - s) in row s and column t, 0 for t < s.
torch::Tensor Decays(double trace_decay, int64_t timesteps, torch::Device device) {
  const torch::Tensor t = torch::arange(timesteps, device);
  const torch::Tensor distance = (t.unsqueeze(0) - t.unsqueeze(1)).to(torch::kFloat);
  return torch::pow(trace_decay, distance.clamp_min(0.0)).masked_fill(distance < 0.0, 0.0);
}

}  // namespace

torch::Tensor HeadChange(const HeadPlasticity& plasticity, const ActionSpace& space,
                         const ModelOutput& output, const PlasticityInputs& inputs) {
  SPIKESERVE_DCHECK(inputs.deviation > 0.0);
  const torch::NoGradGuard no_gradient;
  const torch::Tensor modulator =
      ((inputs.return_to_go - inputs.mean) / inputs.deviation).clamp(-1.0, 1.0) * inputs.mask;
  // sum_t delta_t E_t = sum_s (sum_{t >= s} lambda^{t - s} delta_t) y_s r_s^T
  const torch::Tensor weight = torch::matmul(
      modulator,
      Decays(plasticity.trace_decay, modulator.size(1), modulator.device()).transpose(0, 1));
  const torch::Tensor y = Postsynaptic(plasticity.rule, space, output.logits, inputs.targets);
  const torch::Tensor credit = (y * weight.unsqueeze(-1)).flatten(0, 1);
  const torch::Tensor sum = torch::matmul(credit.transpose(0, 1), output.readout.flatten(0, 1));
  return plasticity.rate / static_cast<double>(modulator.size(0)) * sum;
}

}  // namespace spikeserve
