#include <gtest/gtest.h>
#include <torch/library.h>
#include <torch/types.h>
#include <torch/version.h>

#include <array>
#include <cmath>
#include <string>
#include <tuple>
#include <vector>

#include "tests/support/small_policy.h"
#include "train/model/fading_norms.h"
#include "train/model/loss.h"
#include "train/model/torch_model.h"
#include "train/trainer/device.h"
#include "train/trainer/head_plasticity.h"

namespace spikeserve {
namespace {

constexpr int64_t kClips = 3, kSteps = 6;

ClipTensors RandomClips(uint64_t seed) {
  torch::manual_seed(seed);
  return {.return_to_go = torch::randn({kClips, kSteps}),
          .observations = torch::randn({kClips, kSteps, 4}),
          .actions = torch::rand({kClips, kSteps, 2}),
          .timesteps = torch::arange(kSteps).repeat({kClips, 1}),
          .previous = {}};
}

// Returns a model whose norms have become affine maps.
TorchModel FadedModel(Mode mode) {
  Policy policy = SmallPolicy(SmallConfig(mode));
  int k = 0;
  for (LayerWeights& layer : policy.weights.layers) {
    for (Norm* norm : {&layer.attention_norm, &layer.ffn_norm}) {
      for (float& weight : norm->weight.values) weight = 0.5f + 0.1f * static_cast<float>(k++ % 9);
      for (float& bias : norm->bias.values) bias = 0.05f * static_cast<float>(k++ % 7) - 0.15f;
      norm->weight.values[0] *= -1.0f;
    }
  }
  TorchModel model(policy, Surrogate{});
  model.FadeNorms();
  model.fading_norms()->set_share(0.0);
  const torch::NoGradGuard no_gradient;
  for (uint64_t seed = 0; seed < 40; ++seed) {
    model.ForwardInTraining(RandomClips(seed), torch::ones({kClips, kSteps}));
  }
  return model;
}

class FadingNormsTest : public testing::TestWithParam<Mode> {};

TEST_P(FadingNormsTest, WhatIsStoredWithoutNormsGivesTheSameCurrents) {
  const TorchModel model = FadedModel(GetParam());
  const Policy stored = model.CurrentPolicy();
  EXPECT_EQ(stored.config.norm, NormKind::kNone);
  ASSERT_TRUE(stored.Validate().ok()) << stored.Validate();
  const torch::NoGradGuard no_gradient;
  const ClipTensors clips = RandomClips(100);
  const ModelOutput before = model.Forward(clips);
  const ModelOutput after = TorchModel(stored, Surrogate{}).Forward(clips);
  ASSERT_EQ(before.populations.size(), after.populations.size());
  double spikes = 0.0;
  for (size_t i = 0; i < before.populations.size(); ++i) {
    const Population& expected = before.populations[i];
    const Population& actual = after.populations[i];
    if (!expected.current.defined()) continue;
    EXPECT_TRUE(torch::allclose(actual.current, expected.current, 1e-3, 1e-4))
        << "population " << i;
    spikes += expected.spikes.sum().item<double>();
  }
  EXPECT_GT(spikes, 0.0);
  EXPECT_TRUE(torch::allclose(after.logits, before.logits, 1e-3, 1e-4));
}

INSTANTIATE_TEST_SUITE_P(Modes, FadingNormsTest, testing::Values(Mode::kBaseline, Mode::kFull),
                         [](const auto& mode) { return std::string(ToString(mode.param)); });

TEST(FadingNormsTest, WithAShareOf1TheyAreLayerNorms) {
  const Policy policy = SmallPolicy();
  TorchModel fading(policy, Surrogate{});
  fading.FadeNorms();
  const torch::NoGradGuard no_gradient;
  const ClipTensors clips = RandomClips(1);
  const torch::Tensor expected = TorchModel(policy, Surrogate{}).Forward(clips).logits;
  EXPECT_TRUE(torch::allclose(fading.Forward(clips).logits, expected, 1e-4, 1e-5));
}

TEST(FadingNormsTest, MomentsAreThoseOfTheBatchWithoutPadding) {
  const Policy policy = SmallPolicy();
  const Parameters parameters(policy);
  FadingNorms norms(policy, torch::kCPU);
  norms.set_share(0.0);
  const torch::NoGradGuard no_gradient;
  torch::Tensor x = torch::randn({2, 6, 16});  // three tokens for each of two timesteps
  torch::Tensor mask = torch::ones({2, 2});
  mask[1][1] = 0.0;
  BatchMoments batch = {.mask = mask};
  const torch::Tensor y = norms.Normalize(parameters, x, "layers.0.ffn.norm", &batch);
  const torch::Tensor kept =
      torch::cat({x[0], x[1].slice(0, 0, 3)}, 0);  // all but the last timestep of the second clip
  const NormMoments& moments = batch.by_norm.at("layers.0.ffn.norm");
  EXPECT_TRUE(torch::allclose(moments.mean, kept.mean(0), 1e-4, 1e-5));
  EXPECT_TRUE(torch::allclose(moments.variance, kept.var(0, /*unbiased=*/false), 1e-4, 1e-5));
  EXPECT_TRUE(torch::allclose(torch::cat({y[0], y[1].slice(0, 0, 3)}, 0).mean(0),
                              torch::zeros({16}), 1e-4, 1e-5));
  norms.Follow(batch);
  const auto running = norms.tensors();
  EXPECT_TRUE(torch::allclose(running.at("layers.0.ffn.norm.mean"), 0.1 * moments.mean));
  EXPECT_TRUE(
      torch::allclose(running.at("layers.0.ffn.norm.variance"), 0.9 + 0.1 * moments.variance));
  EXPECT_TRUE(torch::equal(running.at("embed.state.norm.mean"), torch::zeros({16})));
}

Population Firing(Stage stage, double rate, int64_t tokens) {
  return {stage, 0, torch::full({5, 1, tokens, 8}, rate).requires_grad_(), {}};
}

TEST(RateHingeTest, PushesOnlyPopulationsAboveTheirTarget) {
  const std::vector<Population> populations = {Firing(Stage::kQuery, 0.05, 6),
                                               Firing(Stage::kKey, 0.30, 6),
                                               Firing(Stage::kReadout, 0.30, 2)};
  const torch::Tensor hinge =
      RateHinge(populations, {.hidden = 0.10, .readout = 0.25}, torch::ones({1, 2}));
  EXPECT_NEAR(hinge.item<double>(), 0.20 + 0.05, 1e-6);
  hinge.backward();
  EXPECT_FALSE(populations[0].spikes.grad().defined());
  EXPECT_NEAR(populations[1].spikes.grad().sum().item<double>(), 1.0, 1e-5);
  EXPECT_NEAR(populations[2].spikes.grad().sum().item<double>(), 1.0, 1e-5);
}

TEST(RateHingeTest, LeavesPaddingOut) {
  Population population = Firing(Stage::kKey, 0.0, 6);
  population.spikes = torch::zeros({5, 1, 6, 8});
  population.spikes.slice(2, 3, 6).fill_(1.0);  // the three tokens of the second timestep
  const RateTargets targets = {.hidden = 0.1, .readout = 0.1};
  const torch::Tensor first = torch::tensor({1.0f, 0.0f}).unsqueeze(0);
  EXPECT_FALSE(RateHinge({population}, targets, first).defined());
  EXPECT_NEAR(RateHinge({population}, targets, 1.0 - first).item<double>(), 0.9, 1e-6);
}

TEST(RateHingeTest, LeavesPhaseSpikesAlone) {
  EXPECT_FALSE(RateHinge({Firing(Stage::kPhase, 0.5, 2)}, {.hidden = 0.0, .readout = 0.0},
                         torch::ones({1, 2}))
                   .defined());
}

TEST(OperationShareTest, WeighsASpikeByTheSynapsesThatItMeets) {
  const ModelConfig config = {.hidden_size = 8, .context = 4, .ffn_size = 32};
  const torch::Tensor mask = torch::ones({1, 2});
  // All populations have 8 neurons. A coder's spike meets 24 synapses, an FFN coder's 32, a query's
  // 12; the readout and the phase generators do not count.
  const std::vector<Population> populations = {
      Firing(Stage::kCoder, 0.5, 6), Firing(Stage::kFfnIn, 0.1, 6), Firing(Stage::kQuery, 0.2, 6),
      Firing(Stage::kPhase, 0.9, 2), Firing(Stage::kReadout, 0.9, 2)};
  const torch::Tensor share = OperationShare(populations, config, mask);
  EXPECT_NEAR(share.item<double>(), (24 * 0.5 + 32 * 0.1 + 12 * 0.2) / (24 + 32 + 12), 1e-6);
  share.backward();
  EXPECT_NEAR(populations[0].spikes.grad().sum().item<double>(), 24.0 / 68.0, 1e-5);
  EXPECT_FALSE(populations[3].spikes.grad().defined());
  EXPECT_FALSE(OperationShare({}, config, mask).defined()) << "mode dense";
}

TEST(ImitationLossTest, IsTheMaskedCrossEntropyForDiscreteActions) {
  const torch::Tensor logits = torch::tensor({{{0.0f, 0.0f}, {9.0f, -9.0f}}});
  const torch::Tensor targets = torch::tensor({{{0.0f, 1.0f}, {0.0f, 1.0f}}});
  const ActionSpace space = ActionSpace::Discrete(2);
  EXPECT_NEAR(ImitationLoss(space, logits, targets, torch::tensor({{1.0f, 0.0f}}), torch::ones({2}))
                  .item<double>(),
              std::log(2.0), 1e-6);
  EXPECT_NEAR(ImitationLoss(space, logits, targets, torch::tensor({{1.0f, 1.0f}}), torch::ones({2}))
                  .item<double>(),
              (std::log(2.0) + 18.0) / 2.0, 1e-5);
}

TEST(ImitationLossTest, IsTheSquaredDistanceOfTanhForBoxesInUnitsOfTheSpread) {
  const torch::Tensor logits = torch::tensor({{{0.5f}}}), targets = torch::tensor({{{-1.0f}}});
  const ActionSpace space = ActionSpace::Box({-2.0f}, {2.0f});
  const auto loss = [&](float spread) {
    return ImitationLoss(space, logits, targets, torch::ones({1, 1}), torch::tensor({spread}))
        .item<double>();
  };
  EXPECT_NEAR(loss(1.0f), std::pow(std::tanh(0.5) + 1.0, 2.0), 1e-5);
  EXPECT_NEAR(loss(0.5f), 4.0 * std::pow(std::tanh(0.5) + 1.0, 2.0), 1e-5);
}

using torch::Tensor;
#if TORCH_VERSION_MAJOR < 2  // has not all operators on `meta`
using OptionalTensor = c10::optional<Tensor>;

Tensor ReluOnMeta(const Tensor& x) { return torch::empty_like(x); }
Tensor& AbsOnMeta(const Tensor& x, Tensor& out) {
  out.resize_(x.sizes());
  return out;
}

std::tuple<Tensor, Tensor, Tensor> LayerNormOnMeta(const Tensor& x, c10::SymIntArrayRef,
                                                   const OptionalTensor& weight,
                                                   const OptionalTensor& bias, double) {
  EXPECT_TRUE(x.is_meta() && weight->is_meta() && bias->is_meta());
  const Tensor moment = torch::empty_like(x.select(-1, 0));
  return {torch::empty_like(x), moment, moment.clone()};
}

std::tuple<Tensor, Tensor, Tensor> LayerNormBackwardOnMeta(
    const Tensor& gradient, const Tensor& x, c10::SymIntArrayRef, const Tensor&, const Tensor&,
    const OptionalTensor& weight, const OptionalTensor& bias, std::array<bool, 3>) {
  EXPECT_TRUE(gradient.is_meta());
  return {torch::empty_like(x), torch::empty_like(*weight), torch::empty_like(*bias)};
}

Tensor IndexSelectOnMeta(const Tensor& x, int64_t dimension, const Tensor& index) {
  EXPECT_TRUE(x.is_meta() && index.is_meta());
  std::vector<int64_t> shape = x.sizes().vec();
  shape[dimension] = index.size(0);
  return torch::empty(shape, x.options());
}

TORCH_LIBRARY_IMPL(aten, Meta, library) {
  library.impl("relu", ReluOnMeta);
  library.impl("abs.out", AbsOnMeta);
  library.impl("index_select", IndexSelectOnMeta);
  library.impl("native_layer_norm", LayerNormOnMeta);
  library.impl("native_layer_norm_backward", LayerNormBackwardOnMeta);
}
#endif

ClipTensors MetaClips(const Policy& policy) {
  const auto options = torch::TensorOptions(torch::kMeta).dtype(torch::kFloat);
  const auto numbers = options.dtype(torch::kLong);
  return {.return_to_go = torch::empty({kClips, kSteps}, options),
          .observations = torch::empty({kClips, kSteps, policy.observation_size()}, options),
          .actions = torch::empty({kClips, kSteps, policy.action_space.size()}, options),
          .timesteps = torch::empty({kClips, kSteps}, numbers),
          .previous = torch::empty({kClips, policy.observation_size()}, options)};
}

// Tests that a model computes on its device alone. No test machine has a GPU: tensors on torch's
// device `meta` have shapes and no values, and no operator accepts them beside tensors in memory.
class ModelDeviceTest : public testing::TestWithParam<Mode> {};

TEST_P(ModelDeviceTest, ForwardAndBackwardStayOnTheDevice) {
  ModelConfig config = SmallConfig(GetParam());
  config.observation_changes = true;
  const Policy policy = SmallPolicy(config);
  const TorchModel model(policy, Surrogate{}, Arithmetic::kFloat32, {}, /*seed=*/0, torch::kMeta);
  const ModelOutput output = model.Forward(MetaClips(policy));
  EXPECT_TRUE(output.logits.is_meta());
  const torch::Tensor mask = torch::empty({kClips, kSteps}, output.logits.options());
  torch::Tensor loss = ImitationLoss(policy.action_space, output.logits,
                                     torch::empty_like(output.logits), mask, mask);
  if (const auto share = OperationShare(output.populations, config, mask); share.defined()) {
    loss = loss + share;
  }
  loss.backward();
  for (const auto& [name, tensor] : model.parameters().tensors()) {
    EXPECT_TRUE(tensor.is_meta()) << name;
    EXPECT_TRUE(!tensor.grad().defined() || tensor.grad().is_meta()) << name;
  }
  EXPECT_TRUE(model.parameters()["embed.state.weight"].grad().defined());
  EXPECT_TRUE(model.parameters()["head.weight"].grad().defined());
  const torch::Tensor change = HeadChange({.rate = 0.1}, policy.action_space, output,
                                          {.return_to_go = mask,
                                           .targets = torch::empty_like(output.logits),
                                           .mask = mask,
                                           .mean = 0.0,
                                           .deviation = 1.0});
  EXPECT_TRUE(change.is_meta());
}

INSTANTIATE_TEST_SUITE_P(Modes, ModelDeviceTest,
                         testing::Values(Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull,
                                         Mode::kDense),
                         [](const auto& mode) { return std::string(ToString(mode.param)); });

TEST(DeviceTest, NamesAreThoseOfDevicesThatAreHere) {
  EXPECT_TRUE(DeviceNamed("cpu")->is_cpu());
  for (const char* name : {"", "gpu", "cuda:", "cuda:-1", "cuda:x", "cudax", "meta"}) {
    EXPECT_EQ(DeviceNamed(name).status().message(),
              std::string("--device: expected cpu, cuda or cuda:N, received ") + name);
  }
  EXPECT_EQ(DeviceNamed("cuda:99").status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(DeviceTest, IntegersNeedTheProcessor) {
  EXPECT_TRUE(CheckDevice(torch::kCUDA, Arithmetic::kFloat32).ok());
  EXPECT_EQ(CheckDevice(torch::kCUDA, Arithmetic::kInteger).message(),
            "--device: expected cpu with --arithmetic=integer, received cuda");
  EXPECT_TRUE(CheckDevice(torch::kCPU, Arithmetic::kInteger).ok());
}

}  // namespace
}  // namespace spikeserve
