#include "train/model/clip_tensors.h"

namespace spikeserve {

torch::Tensor StateTokens(const torch::Tensor& x, int64_t dimension) {
  return x.slice(dimension, 1, torch::indexing::None, kTokens);
}

// Not repeat_interleave(), which not every device has.
torch::Tensor ForEachToken(const torch::Tensor& x, int64_t dimension, int64_t times) {
  std::vector<int64_t> shape = x.sizes().vec();
  shape.insert(shape.begin() + dimension + 1, times);
  return x.unsqueeze(dimension + 1).expand(shape).flatten(dimension, dimension + 1);
}

torch::Tensor ReturnInput(const Policy& policy, const ClipTensors& clips) {
  return ((clips.return_to_go - policy.return_offset) / policy.return_scale).unsqueeze(-1);
}

torch::Tensor StateInput(const Policy& policy, const Parameters& parameters,
                         const ClipTensors& clips) {
  const torch::Tensor& seen = clips.observations;
  const torch::Tensor s = (seen - parameters["observation.mean"]) / parameters["observation.std"];
  if (!policy.config.observation_changes) return s;
  const torch::Tensor before =
      torch::cat({clips.previous.unsqueeze(1), seen.slice(1, 0, seen.size(1) - 1)}, 1);
  return torch::cat({s, (seen - before) / parameters["observation.change_std"]}, -1);
}

torch::Tensor PhaseTimes(const ModelConfig& config, const torch::Tensor& timesteps) {
  const torch::Tensor tick =
      torch::arange(config.ticks, timesteps.options().dtype(torch::kDouble)).view({-1, 1, 1, 1});
  const torch::Tensor timestep = timesteps.to(torch::kDouble).unsqueeze(0).unsqueeze(-1);
  return config.phase_clock == PhaseClock::kWindow
             ? (tick + 1.0).expand({-1, timestep.size(1), timestep.size(2), 1})
             : timestep + tick / config.ticks;
}

}  // namespace spikeserve
