#include "train/model/loss.h"

namespace spikeserve {
namespace {

constexpr double kLeastWeight = 1e-12;  // of a batch

// Returns the mean spikes per neuron and tick over the tokens of all steps with mask 1.
torch::Tensor Rate(const torch::Tensor& spikes, const torch::Tensor& mask) {
  const int64_t tokens_per_step = spikes.size(2) / mask.size(1);
  const torch::Tensor token_mask =
      tokens_per_step == 1 ? mask : ForEachToken(mask, 1, tokens_per_step);
  const torch::Tensor per_token = spikes.mean(std::vector<int64_t>{0, 3});
  return (per_token * token_mask).sum() / token_mask.sum();
}

// Returns the number of synapses that a spike meets; see OperationShare.
int FanOut(Stage stage, const ModelConfig& config) {
  switch (stage) {
    case Stage::kCoder:
      return 3 * config.hidden_size;
    case Stage::kQuery:
    case Stage::kKey:
    case Stage::kValue:
      return 3 * config.context;
    case Stage::kFfnIn:
      return config.ffn_size;
    case Stage::kFfnHidden:
      return config.hidden_size;
    case Stage::kPhase:
    case Stage::kReadout:
      break;
  }
  return 0;
}

}  // namespace

torch::Tensor ImitationLoss(const ActionSpace& space, const torch::Tensor& logits,
                            const torch::Tensor& targets, const torch::Tensor& weights,
                            const torch::Tensor& spread) {
  const torch::Tensor losses = space.is_discrete()
                                   ? -(torch::log_softmax(logits, -1) * targets).sum(-1)
                                   : ((torch::tanh(logits) - targets) / spread).square().mean(-1);
  // A batch may consist of steps without weight.
  return (losses * weights).sum() / weights.sum().clamp_min(kLeastWeight);
}

torch::Tensor RateHinge(const std::vector<Population>& populations, const RateTargets& targets,
                        const torch::Tensor& mask) {
  torch::Tensor sum;
  for (const Population& population : populations) {
    if (population.stage == Stage::kPhase) continue;
    const double target = population.stage == Stage::kReadout ? targets.readout : targets.hidden;
    if (target >= 1.0) continue;
    const torch::Tensor excess = Rate(population.spikes, mask) - target;
    // A hinge of 0 has no gradient. Keeping it out of the graph saves a pass over the population.
    if (excess.item<double>() <= 0.0) continue;
    sum = sum.defined() ? sum + excess : excess;
  }
  return sum;
}

torch::Tensor OperationShare(const std::vector<Population>& populations, const ModelConfig& config,
                             const torch::Tensor& mask) {
  torch::Tensor sum;
  double possible = 0.0;
  for (const Population& population : populations) {
    const auto synapses =
        static_cast<double>(population.spikes.size(3) * int64_t{FanOut(population.stage, config)});
    if (synapses == 0.0) continue;
    const torch::Tensor operations = synapses * Rate(population.spikes, mask);
    sum = sum.defined() ? sum + operations : operations;
    possible += synapses;
  }
  return sum.defined() ? sum / possible : sum;
}

}  // namespace spikeserve
