// Tests of phase spikes on torch tensors: the spikes, and the gradients of omega and phi.

#include "core/neuron/phase.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>

#include "train/neuron/phase_function.h"

namespace spikeserve {
namespace {

constexpr float kSlope = 10.0f;

TEST(PhaseFunctionTest, FiresWhereTheSineIsPositive) {
  const torch::Tensor omega = torch::tensor({0.3f, 4.0f}), phi = torch::tensor({0.0f, 2.0f});
  const torch::Tensor tau = torch::arange(200, torch::kDouble).unsqueeze(-1) / 10.0;
  const torch::Tensor spikes = PhaseSpikes(omega, phi, tau, {});
  ASSERT_EQ(spikes.sizes(), (std::vector<int64_t>{200, 2}));
  for (int i = 0; i < 200; ++i) {
    EXPECT_EQ(spikes[i][0].item<float>() > 0.0f, PhaseSpike(0.3f, 0.0f, i / 10.0));
    EXPECT_EQ(spikes[i][1].item<float>() > 0.0f, PhaseSpike(4.0f, 2.0f, i / 10.0));
  }
}

TEST(PhaseFunctionTest, OmegasGradientIsDividedByTheLargestTime) {
  torch::Tensor omega = torch::tensor({0.7f}), phi = torch::tensor({0.4f});
  omega.requires_grad_();
  phi.requires_grad_();
  const torch::Tensor tau = torch::tensor({3.0, 8.0}, torch::kDouble).unsqueeze(-1);
  PhaseSpikes(omega, phi, tau, {SurrogateKind::kFastSigmoid, kSlope}).sum().backward();
  double expected_omega = 0.0, expected_phi = 0.0;
  for (const double t : {3.0, 8.0}) {
    const double angle = 0.7 * t + 0.4;
    const double gradient = std::cos(angle) / std::pow(1.0 + 10.0 * std::abs(std::sin(angle)), 2.0);
    expected_phi += gradient;
    expected_omega += gradient * t / 8.0;
  }
  EXPECT_NEAR(phi.grad().item<double>(), expected_phi, 1e-5);
  EXPECT_NEAR(omega.grad().item<double>(), expected_omega, 1e-5);
}

}  // namespace
}  // namespace spikeserve
