// Tests that compare the fused LIF function with loops over ticks, and the surrogate gradients with
// their antiderivatives.
#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <string>
#include <variant>
#include <vector>

#include "core/neuron/lif.h"
#include "core/neuron/phase.h"
#include "train/neuron/lif_function.h"
#include "train/neuron/lif_operators.h"
#include "train/neuron/phase_function.h"
#include "train/neuron/surrogate.h"

namespace spikeserve {
namespace {

constexpr int kTicks = 9;
constexpr int64_t kNeurons = 1300;  // more than two blocks of the kernels, and no multiple of one

float Derivative(SurrogateKind kind, float slope, float u) {
  float value = 0.0f;
  WithDerivative({kind, slope}, [&](auto derivative) { value = derivative(u); });
  return value;
}

// Returns the antiderivative of the surrogate, which autograd differentiates to the surrogate.
torch::Tensor Antiderivative(const Surrogate& surrogate, const torch::Tensor& u) {
  const double k = static_cast<double>(surrogate.slope);
  switch (surrogate.kind) {
    case SurrogateKind::kFastSigmoid:
      return u / (1.0 + k * u.abs());
    case SurrogateKind::kSigmoid:
      return torch::sigmoid(k * u) / k;
    case SurrogateKind::kPiecewiseLinear: {
      const torch::Tensor near = u.clamp(-1.0 / k, 1.0 / k);
      return near - 0.5 * k * near * near.abs();
    }
  }
  return u;
}

// Returns spikes computed with one graph node per tick: their values are those of the step
// function, their gradients those of the antiderivative, and the reset is detached.
torch::Tensor NaiveLif(const torch::Tensor& current, const LifOptions& options) {
  std::vector<torch::Tensor> spikes;
  torch::Tensor membrane = torch::zeros_like(current[0]);
  for (int tick = 0; tick < options.ticks; ++tick) {
    membrane = options.neuron.decay * membrane + current[tick];
    const torch::Tensor u = membrane - options.neuron.threshold;
    const torch::Tensor smooth = Antiderivative(options.surrogate, u);
    const torch::Tensor step = (u >= 0).to(torch::kFloat);
    spikes.push_back(step + (smooth - smooth.detach()));
    membrane = membrane * (1.0 - step);
  }
  return torch::stack(spikes);
}

torch::Tensor RandomCurrent(std::vector<int64_t> shape) {
  torch::manual_seed(3);
  return torch::rand(shape) * 0.8 - 0.1;
}

TEST(SurrogateTest, DerivativesAreAsStated) {
  const float k = 10.0f;
  for (const float u : {-1.5f, -0.21f, -0.05f, 0.0f, 0.03f, 0.4f}) {
    const double f = 1.0 / (1.0 + std::exp(-10.0 * static_cast<double>(u)));
    EXPECT_NEAR(Derivative(SurrogateKind::kFastSigmoid, k, u),
                1.0 / std::pow(1.0 + 10.0 * std::abs(static_cast<double>(u)), 2.0), 1e-6);
    EXPECT_NEAR(Derivative(SurrogateKind::kSigmoid, k, u), f * (1.0 - f), 1e-6);
    EXPECT_NEAR(Derivative(SurrogateKind::kPiecewiseLinear, k, u),
                std::max(0.0, 1.0 - 10.0 * std::abs(static_cast<double>(u))), 1e-6);
  }
}

TEST(SurrogateTest, UnknownNameIsRefusedWithTheNamesThereAre) {
  EXPECT_EQ(ParseEnum<SurrogateKind>("surrogate", "arctan").status().message(),
            "surrogate: expected fast_sigmoid, sigmoid or piecewise_linear, received \"arctan\"");
}

TEST(LifFunctionTest, PerTickSpikesEqualTheNeuronSteppedAlone) {
  const torch::Tensor current = RandomCurrent({kTicks, kNeurons});
  const torch::Tensor spikes =
      LifPerTick(current, {.neuron = {}, .ticks = kTicks, .surrogate = {}});
  ASSERT_EQ(spikes.sizes(), current.sizes());
  int fired = 0;
  for (int64_t i = 0; i < kNeurons; ++i) {
    float membrane = 0.0f;
    for (int tick = 0; tick < kTicks; ++tick) {
      const bool spike = Lif().Step(current[tick][i].item<float>(), membrane);
      ASSERT_EQ(spikes[tick][i].item<float>(), spike ? 1.0f : 0.0f) << "neuron " << i;
      fired += spike;
    }
  }
  EXPECT_GT(fired, kNeurons);
}

TEST(LifFunctionTest, ConstantCurrentFiresWithTheCodersPeriod) {
  const torch::Tensor current = RandomCurrent({2, kNeurons / 2});
  const torch::Tensor spikes =
      LifConstant(current, {.neuron = {}, .ticks = kTicks, .surrogate = {}});
  const torch::Tensor flat = current.flatten(), trains = spikes.flatten(1);
  ASSERT_EQ(spikes.dim(), 3);
  for (int64_t i = 0; i < flat.numel(); ++i) {
    const int period = Lif().Period(flat[i].item<float>(), kTicks);
    for (int tick = 1; tick <= kTicks; ++tick) {
      const bool spike = period > 0 && tick % period == 0;
      ASSERT_EQ(trains[tick - 1][i].item<float>(), spike ? 1.0f : 0.0f) << "neuron " << i;
    }
  }
}

LifOptions LeakyOptions(SurrogateKind kind) {
  return {.neuron = {.decay = 0.9f, .threshold = 0.8f}, .ticks = kTicks, .surrogate = {kind, 4.0f}};
}

class LifOperatorsTest : public testing::TestWithParam<SurrogateKind> {};

// What runs on other devices computes what the kernels of the processor compute.
TEST_P(LifOperatorsTest, AreTheKernels) {
  const LifOptions options = LeakyOptions(GetParam());
  const torch::Tensor gradient = torch::randn({kTicks, kNeurons});
  for (const bool constant : {false, true}) {
    torch::Tensor current = RandomCurrent(constant ? std::vector<int64_t>{kNeurons}
                                                   : std::vector<int64_t>{kTicks, kNeurons});
    current.requires_grad_();
    const torch::Tensor spikes =
        constant ? LifConstant(current, options) : LifPerTick(current, options);
    EXPECT_TRUE(torch::equal(
        spikes, LifForwardOperators(options.neuron, kTicks, constant, current.detach())));
    (spikes * gradient).sum().backward();
    const torch::Tensor by_operators = LifBackwardOperators(
        options.neuron, kTicks, constant, options.surrogate, current.detach(), gradient);
    EXPECT_TRUE(torch::allclose(current.grad(), by_operators, 1e-5, 1e-6));
  }
  const torch::Tensor u = torch::linspace(-0.5, 0.5, 11);
  const torch::Tensor derivatives = SurrogateDerivative(options.surrogate, u);
  for (int64_t i = 0; i < u.numel(); ++i) {
    EXPECT_NEAR(derivatives[i].item<float>(), Derivative(GetParam(), 4.0f, u[i].item<float>()),
                1e-6);
  }
}

INSTANTIATE_TEST_SUITE_P(Kinds, LifOperatorsTest,
                         testing::Values(SurrogateKind::kFastSigmoid, SurrogateKind::kSigmoid,
                                         SurrogateKind::kPiecewiseLinear));

class LifGradientTest : public testing::TestWithParam<SurrogateKind> {};

// Checks the backward pass of both variants, with a gradient that differs between ticks and with
// one that does not.
TEST_P(LifGradientTest, EqualsTheGraphOverTicks) {
  const LifOptions options = LeakyOptions(GetParam());
  const torch::Tensor weight = torch::randn({kTicks, kNeurons});
  for (const bool constant : {false, true}) {
    for (const bool same_at_every_tick : {false, true}) {
      torch::Tensor fused = RandomCurrent(constant ? std::vector<int64_t>{kNeurons}
                                                   : std::vector<int64_t>{kTicks, kNeurons});
      torch::Tensor naive = fused.clone();
      fused.requires_grad_();
      naive.requires_grad_();
      const torch::Tensor spikes =
          constant ? LifConstant(fused, options) : LifPerTick(fused, options);
      const torch::Tensor expected =
          NaiveLif(constant ? naive.expand({kTicks, kNeurons}) : naive, options);
      ASSERT_TRUE(torch::equal(spikes, expected));
      if (same_at_every_tick) {
        (spikes.sum(0) * weight[0]).sum().backward();
        (expected.sum(0) * weight[0]).sum().backward();
      } else {
        (spikes * weight).sum().backward();
        (expected * weight).sum().backward();
      }
      EXPECT_GT(naive.grad().abs().sum().item<float>(), 1.0f);
      EXPECT_TRUE(torch::allclose(fused.grad(), naive.grad(), 1e-4, 1e-5))
          << "constant " << constant << ", same at every tick " << same_at_every_tick;
    }
  }
}

constexpr int64_t kWidth = 26;  // of the population; kNeurons is a multiple of it
constexpr ShiftLif kShifted = {.leak = 32};

// Returns options of integer neurons, whose thresholds and biases are at most `size` times the
// largest ones.
IntegerLifOptions IntegerOptions(const Surrogate& surrogate, double size = 1.0) {
  torch::manual_seed(5);
  return {.neuron = kShifted,
          .threshold = torch::ceil(torch::randint(1, 16385, {kWidth}) * size).to(torch::kFloat),
          .scale = torch::rand({kWidth}) * 1e-4 + 1e-5,
          .ticks = kTicks,
          .surrogate = surrogate,
          .bias = torch::floor(torch::randint(-3000, 3000, {kWidth}) * size).to(torch::kFloat),
          .events = torch::randint(0, 2, {kTicks, kNeurons / kWidth}).to(torch::kFloat)};
}

// Integer currents of 16 bits for `kNeurons` neurons, many of which saturate the membrane at a size
// of 1.
torch::Tensor RandomIntegerCurrent(const IntegerLifOptions& options, double size = 1.0) {
  torch::manual_seed(4);
  const std::vector<int64_t> shape = {kTicks, kNeurons / kWidth, kWidth};
  const torch::Tensor current =
      torch::floor(torch::randint(-29000, 29000, shape) * torch::randint(0, 2, shape) * size)
          .to(torch::kFloat);
  return current * options.events.unsqueeze(-1) + options.bias;
}

// Returns whether neuron i fires at a tick.
bool StepAlone(const IntegerLifOptions& options, int tick, int64_t i, int16_t input,
               int16_t& membrane) {
  const auto threshold = static_cast<int16_t>(options.threshold[i % kWidth].item<float>());
  const auto bias = static_cast<int16_t>(options.bias[i % kWidth].item<float>());
  kShifted.Leak(bias, membrane);
  if (options.events[tick][i / kWidth].item<float>() == 0.0f) return false;
  return ShiftLif::Charge(static_cast<int16_t>(input - bias), threshold, membrane);
}

// Large numbers saturate membranes; with small ones the rounding of a membrane decides on spikes.
TEST(IntegerLifFunctionTest, SpikesEqualTheNeuronSteppedAlone) {
  for (const double size : {1.0, 1e-3}) {
    const IntegerLifOptions options = IntegerOptions({}, size);
    const torch::Tensor current = RandomIntegerCurrent(options, size);
    const torch::Tensor spikes = IntegerLifPerTick(current, options);
    ASSERT_EQ(spikes.sizes(), current.sizes());
    const torch::Tensor flat = current.flatten(1), trains = spikes.flatten(1);
    int fired = 0;
    for (int64_t i = 0; i < kNeurons; ++i) {
      int16_t membrane = 0;
      for (int tick = 0; tick < kTicks; ++tick) {
        const auto input = static_cast<int16_t>(flat[tick][i].item<float>());
        const bool spike = StepAlone(options, tick, i, input, membrane);
        ASSERT_EQ(trains[tick][i].item<float>(), spike ? 1.0f : 0.0f) << "neuron " << i;
        fired += spike;
      }
    }
    EXPECT_GT(fired, kNeurons / 2);
  }
}

// Returns the membranes [neurons] at the end of a tick, without the reset.
torch::Tensor ChargeExactly(const IntegerLifOptions& options, int tick, const torch::Tensor& kept,
                            const torch::Tensor& current) {
  const torch::Tensor membrane = kept.to(torch::kDouble);
  const torch::Tensor leaked =
      (membrane - torch::floor((membrane + 4.0) / 8.0) + options.bias).clamp(-32768.0, 32767.0);
  const torch::Tensor charged = (leaked + current - options.bias).clamp(-32768.0, 32767.0);
  return torch::where(options.events[tick].unsqueeze(-1) != 0.0, charged, leaked).to(torch::kFloat);
}

// As NaiveLif, for integer neurons: the values are those of integer arithmetic, the gradients those
// without rounding and saturation.
torch::Tensor NaiveIntegerLif(const torch::Tensor& current, const IntegerLifOptions& options) {
  std::vector<torch::Tensor> spikes;
  torch::Tensor membrane = torch::zeros_like(current[0]);
  for (int tick = 0; tick < options.ticks; ++tick) {
    const torch::Tensor smooth_membrane = 0.875 * membrane + current[tick];
    const torch::Tensor exact =
        ChargeExactly(options, tick, membrane.detach(), current[tick].detach());
    membrane = smooth_membrane + (exact - smooth_membrane.detach());
    const torch::Tensor u = options.scale * (exact - options.threshold);
    const torch::Tensor through = u + options.scale * (smooth_membrane - smooth_membrane.detach());
    torch::Tensor smooth = Antiderivative(options.surrogate, through);
    torch::Tensor step = (exact >= options.threshold).to(torch::kFloat);
    const torch::Tensor event = options.events[tick].unsqueeze(-1);
    smooth = smooth * event;
    step = step * event;
    spikes.push_back(step + (smooth - smooth.detach()));
    membrane = exact * (1.0 - step) + (membrane - membrane.detach()) * (1.0 - step);
  }
  return torch::stack(spikes);
}

TEST_P(LifGradientTest, OfIntegerNeuronsEqualsTheGraphOverTicks) {
  const torch::Tensor weight = torch::randn({kTicks, kNeurons / kWidth, kWidth});
  const IntegerLifOptions options = IntegerOptions({GetParam(), 4.0f});
  for (const bool same_at_every_tick : {false, true}) {
    torch::Tensor fused = RandomIntegerCurrent(options);
    torch::Tensor naive = fused.clone();
    fused.requires_grad_();
    naive.requires_grad_();
    const torch::Tensor spikes = IntegerLifPerTick(fused, options);
    const torch::Tensor expected = NaiveIntegerLif(naive, options);
    ASSERT_TRUE(torch::equal(spikes, torch::round(expected)));
    for (const torch::Tensor& output : {spikes, expected}) {
      (same_at_every_tick ? (output.sum(0) * weight[0]).sum() : (output * weight).sum()).backward();
    }
    EXPECT_GT(naive.grad().abs().sum().item<float>(), 1e-2f);
    EXPECT_TRUE(torch::allclose(fused.grad(), naive.grad(), 1e-3, 1e-9))
        << "same at every tick " << same_at_every_tick;
  }
}

INSTANTIATE_TEST_SUITE_P(Surrogates, LifGradientTest,
                         testing::Values(SurrogateKind::kFastSigmoid, SurrogateKind::kSigmoid,
                                         SurrogateKind::kPiecewiseLinear),
                         [](const auto& test) { return std::string(ToString(test.param)); });

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
