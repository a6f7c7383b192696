#include "train/neuron/phase_function.h"

#include <torch/csrc/autograd/custom_function.h>

#include <vector>

#include "core/neuron/phase.h"
#include "train/neuron/lif_operators.h"

namespace spikeserve {
namespace {

using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// Returns the spikes exactly as the engines compute them.
torch::Tensor SpikesOf(const torch::Tensor& omega, const torch::Tensor& phi,
                       const torch::Tensor& times) {
  std::vector<int64_t> shape = times.sizes().vec();
  const int64_t heads = omega.numel();
  shape.back() = heads;
  torch::Tensor spikes = torch::empty(shape, omega.options());
  const double* time = times.data_ptr<double>();
  const float* frequency = omega.data_ptr<float>();
  const float* offset = phi.data_ptr<float>();
  float* out = spikes.data_ptr<float>();
  for (int64_t i = 0; i < spikes.numel(); ++i) {
    const int64_t k = i % heads;
    out[i] = PhaseSpike(frequency[k], offset[k], time[i / heads]) ? 1.0f : 0.0f;
  }
  return spikes;
}

// Returns ds/du for every element of u.
torch::Tensor DerivativeOf(const Surrogate& surrogate, const torch::Tensor& u) {
  if (!u.is_cpu()) return SurrogateDerivative(surrogate, u);
  torch::Tensor derivative = torch::empty_like(u);
  const float* from = u.data_ptr<float>();
  float* to = derivative.data_ptr<float>();
  WithDerivative(surrogate, [&](auto function) {
    for (int64_t i = 0; i < u.numel(); ++i) to[i] = function(from[i]);
  });
  return derivative;
}

struct PhaseFunction : torch::autograd::Function<PhaseFunction> {
  static torch::Tensor forward(AutogradContext* context, const torch::Tensor& omega,
                               const torch::Tensor& phi, const torch::Tensor& tau,
                               const Surrogate& surrogate) {
    const torch::Tensor times = tau.contiguous();
    context->save_for_backward({omega, phi, times});
    context->saved_data["kind"] = static_cast<int64_t>(surrogate.kind);
    context->saved_data["slope"] = static_cast<double>(surrogate.slope);
    return omega.is_cpu() ? SpikesOf(omega, phi, times)
                          : (torch::sin(omega * times + phi) > 0.0).to(torch::kFloat);
  }

  static tensor_list backward(AutogradContext* context, tensor_list gradients) {
    const auto saved = context->get_saved_variables();
    const torch::Tensor& tau = saved[2];
    const Surrogate surrogate = {
        .kind = static_cast<SurrogateKind>(context->saved_data["kind"].toInt()),
        .slope = static_cast<float>(context->saved_data["slope"].toDouble())};
    const torch::Tensor angle = saved[0] * tau + saved[1];  // float64, as in the forward pass
    const torch::Tensor membrane = torch::sin(angle).to(torch::kFloat).contiguous();
    const torch::Tensor gradient =
        (gradients[0] * DerivativeOf(surrogate, membrane) * torch::cos(angle))
            .reshape({-1, saved[0].numel()});
    const torch::Tensor largest = tau.abs().amax().clamp_min(1.0);
    const torch::Tensor phi = gradient.sum(0);
    const torch::Tensor omega = (gradient * tau.reshape({-1, 1})).sum(0) / largest;
    return {omega.to(torch::kFloat), phi.to(torch::kFloat), torch::Tensor(), torch::Tensor()};
  }
};

}  // namespace

torch::Tensor PhaseSpikes(const torch::Tensor& omega, const torch::Tensor& phi,
                          const torch::Tensor& tau, const Surrogate& surrogate) {
  return PhaseFunction::apply(omega, phi, tau, surrogate);
}

}  // namespace spikeserve
