#include "train/model/loss.h"

namespace spikeserve {
namespace {

// Returns the mean spikes per neuron and tick over the tokens of all steps with mask 1.
torch::Tensor Rate(const torch::Tensor& spikes, const torch::Tensor& mask) {
  const int64_t tokens_per_step = spikes.size(2) / mask.size(1);
  const torch::Tensor token_mask =
      tokens_per_step == 1 ? mask : mask.repeat_interleave(tokens_per_step, 1);
  const torch::Tensor per_token = spikes.mean(std::vector<int64_t>{0, 3});
  return (per_token * token_mask).sum() / token_mask.sum();
}

}  // namespace

torch::Tensor ImitationLoss(const ActionSpace& space, const torch::Tensor& logits,
                            const torch::Tensor& targets, const torch::Tensor& weights) {
  const torch::Tensor losses = space.is_discrete()
                                   ? -(torch::log_softmax(logits, -1) * targets).sum(-1)
                                   : (torch::tanh(logits) - targets).square().mean(-1);
  return (losses * weights).sum() / weights.sum();
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

}  // namespace spikeserve
