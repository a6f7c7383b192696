#include "train/model/fading_norms.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <vector>

#include "tests/support/small_policy.h"
#include "train/model/torch_model.h"

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

}  // namespace
}  // namespace spikeserve
