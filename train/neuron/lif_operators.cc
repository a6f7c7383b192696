#include "train/neuron/lif_operators.h"

#include <ATen/ATen.h>

#include <vector>

namespace spikeserve {
namespace {

// Returns the distances u = V - V_th of the membranes before the reset, one tensor for each tick.
std::vector<torch::Tensor> Distances(const Lif& neuron, int ticks, bool constant,
                                     const torch::Tensor& current) {
  std::vector<torch::Tensor> distances;
  torch::Tensor kept = at::zeros_like(constant ? current : current.select(0, 0));
  for (int tick = 0; tick < ticks; ++tick) {
    const torch::Tensor membrane =
        neuron.decay * kept + (constant ? current : current.select(0, tick));
    distances.push_back(membrane - neuron.threshold);
    kept = membrane.masked_fill(membrane >= neuron.threshold, 0.0);
  }
  return distances;
}

}  // namespace

torch::Tensor SurrogateDerivative(const Surrogate& surrogate, const torch::Tensor& u) {
  const float k = surrogate.slope;
  switch (surrogate.kind) {
    case SurrogateKind::kFastSigmoid:
      return (1.0 + k * u.abs()).square().reciprocal();
    case SurrogateKind::kSigmoid: {
      const torch::Tensor f = at::sigmoid(k * u);
      return f * (1.0 - f);
    }
    case SurrogateKind::kPiecewiseLinear:
      break;
  }
  return (1.0 - k * u.abs()).clamp_min(0.0);
}

torch::Tensor LifForwardOperators(const Lif& neuron, int ticks, bool constant,
                                  const torch::Tensor& current) {
  std::vector<torch::Tensor> spikes;
  for (const torch::Tensor& u : Distances(neuron, ticks, constant, current)) {
    spikes.push_back((u >= 0.0).to(current.scalar_type()));
  }
  return at::stack(spikes);
}

torch::Tensor LifBackwardOperators(const Lif& neuron, int ticks, bool constant,
                                   const Surrogate& surrogate, const torch::Tensor& current,
                                   const torch::Tensor& spike_gradient) {
  const std::vector<torch::Tensor> distances = Distances(neuron, ticks, constant, current);
  std::vector<torch::Tensor> gradients(ticks);
  torch::Tensor later = at::zeros_like(distances[0]);  // decay dL/dV of the following tick
  for (int tick = ticks - 1; tick >= 0; --tick) {
    const torch::Tensor& u = distances[tick];
    gradients[tick] = spike_gradient.select(0, tick) * SurrogateDerivative(surrogate, u) +
                      later.masked_fill(u >= 0.0, 0.0);
    later = neuron.decay * gradients[tick];
  }
  const torch::Tensor by_tick = at::stack(gradients);
  return constant ? by_tick.sum(0) : by_tick;
}

}  // namespace spikeserve
