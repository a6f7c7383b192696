// Tests that switch off each part of a policy, or the neurons that never fire, and compare the
// readouts of the engine.
#include "train/evaluation/ablation.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <memory>
#include <vector>

#include "core/engine/factory/engine_factory.h"
#include "core/quantize/prune_hidden.h"
#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"
#include "train/data/dataset.h"
#include "train/evaluation/calibration.h"

namespace spikeserve {
namespace {

// Returns a policy for observations of length 1, with increased weights and many ticks, so that
// every part influences the readout.
Policy MakePolicy(Mode mode = Mode::kFull) {
  ModelConfig config = SmallConfig(mode);
  config.ticks = 20;
  Policy policy = RandomPolicy(config, 1, ActionSpace::Discrete(2), 7);
  for (LayerWeights& layer : policy.weights.layers) {
    for (Linear* linear : {&layer.query, &layer.key, &layer.value, &layer.attention_output}) {
      for (float& weight : linear->weight.values) weight *= 8.0f;
    }
    for (float& weight : layer.routing_gate.weight.values) weight *= 8.0f;
  }
  return policy;
}

// Returns the readout of the last of four steps. `first` is the first observation, `shift` is the
// return-to-go of every step.
std::vector<float> Readouts(const Policy& policy, float first, float shift) {
  const auto engine = MakeEngine(std::make_shared<const Policy>(policy));
  const auto context = engine->NewContext();
  Engine::Output output;
  for (int t = 0; t < 4; ++t) {
    const std::vector<float> observation = {t == 0 ? first : 0.3f * static_cast<float>(t)};
    engine->Decide(*context, shift, observation, &output);
    engine->AppendAction(*context, std::vector<float>{1.0f, 0.0f});
  }
  return output.readout;
}

TEST(AblationTest, WithoutContextThePastIsForgotten) {
  Policy policy = MakePolicy();
  EXPECT_NE(Readouts(policy, -3.0f, 0.0f), Readouts(policy, 3.0f, 0.0f));
  ASSERT_TRUE(Ablate("context", &policy).ok());
  EXPECT_EQ(Readouts(policy, -3.0f, 0.0f), Readouts(policy, 3.0f, 0.0f));
}

TEST(AblationTest, WithoutReturnItIsNotHeard) {
  Policy policy = MakePolicy();
  EXPECT_NE(Readouts(policy, 0.0f, -2.0f), Readouts(policy, 0.0f, 2.0f));
  ASSERT_TRUE(Ablate("return", &policy).ok());
  EXPECT_EQ(Readouts(policy, 0.0f, -2.0f), Readouts(policy, 0.0f, 2.0f));
}

TEST(AblationTest, AttentionRoutingAndPhaseChangeWhatIsComputed) {
  for (const char* part : {"attention", "routing", "phase"}) {
    Policy policy = MakePolicy();
    const std::vector<float> before = Readouts(policy, 1.0f, 0.0f);
    ASSERT_TRUE(Ablate(part, &policy).ok());
    EXPECT_NE(Readouts(policy, 1.0f, 0.0f), before) << part;
    EXPECT_TRUE(policy.Validate().ok());
  }
}

TEST(AblationTest, WithoutPhaseTheClockIsNotHeard) {
  Policy policy = MakePolicy(), shifted = policy;
  for (float& phi : shifted.weights.phase_phi.values) phi += 1.5f;
  EXPECT_NE(Readouts(policy, 1.0f, 0.0f), Readouts(shifted, 1.0f, 0.0f));
  ASSERT_TRUE(Ablate("phase", &policy).ok());
  ASSERT_TRUE(Ablate("phase", &shifted).ok());
  EXPECT_EQ(Readouts(policy, 1.0f, 0.0f), Readouts(shifted, 1.0f, 0.0f));
}

TEST(AblationTest, WhatIsNotThereCannotBeSwitchedOff) {
  Policy baseline = MakePolicy(Mode::kBaseline), dense = MakePolicy(Mode::kDense);
  EXPECT_EQ(Ablate("phase", &baseline).message(),
            "ablate: a policy of mode baseline has no phase to switch off");
  EXPECT_EQ(Ablate("attention", &dense).message(),
            "ablate: a policy of mode dense has no attention to switch off");
  EXPECT_EQ(
      Ablate("head", &baseline).message(),
      "ablate: expected context, changes, attention, phase, routing or return, received 'head'");
}

// Hidden neurons of random policies are busy. Those of this one with an even number are silent, in
// both layers, unless `level` is high.
Policy IntegerPolicy(float level) {
  Policy policy = SmallPolicy(SmallConfig(), ActionSpace::Discrete(2), 1);
  policy.environment = "CartPole-v1";
  for (LayerWeights& layer : policy.weights.layers) {
    for (size_t j = 0; j < layer.ffn_hidden.bias.values.size(); j += 2) {
      layer.ffn_hidden.bias.values[j] = level;
    }
  }
  return *QuantizeToInteger(policy);
}

// Returns the readouts of all decisions of the episode.
std::vector<std::vector<float>> Readouts(const Policy& policy, const Episode& episode) {
  const auto engine = MakeEngine(std::make_shared<const Policy>(policy));
  const auto context = engine->NewContext();
  const std::vector<float> returns = ReturnsToGo(episode);
  const auto size = static_cast<size_t>(policy.observation_size());
  std::vector<float> encoded(policy.action_space.size());
  std::vector<std::vector<float>> readouts;
  for (size_t t = 0; t < returns.size(); ++t) {
    Engine::Output output;
    engine->Decide(*context, returns[t],
                   absl::MakeConstSpan(episode.observations).subspan(t * size, size), &output);
    policy.action_space.Encode(episode.actions[t], absl::MakeSpan(encoded));
    engine->AppendAction(*context, encoded);
    readouts.push_back(output.readout);
  }
  return readouts;
}

TEST(CalibrationTest, WithoutItsSilentNeuronsAPolicyDecidesTheSame) {
  const Policy policy = IntegerPolicy(-4.0f);
  const auto episodes = PlayCalibrationEpisodes(policy);
  ASSERT_TRUE(episodes.ok()) << episodes.status();
  ASSERT_EQ(episodes->size(), kCalibrationEpisodes);
  const Policy pruned = PruneHidden(policy, FiringHiddenNeurons(policy, *episodes));
  ASSERT_TRUE(pruned.Validate().ok()) << pruned.Validate();
  EXPECT_LE(pruned.config.ffn_size, policy.config.ffn_size / 2);
  EXPECT_GT(pruned.config.ffn_size, 1);
  for (const Episode& episode : *episodes) {
    ASSERT_EQ(Readouts(pruned, episode), Readouts(policy, episode));
  }
}

TEST(CalibrationTest, EveryNeuronThatFiresIsNeeded) {
  const Policy policy = IntegerPolicy(4.0f);
  const auto episodes = PlayCalibrationEpisodes(policy);
  ASSERT_TRUE(episodes.ok()) << episodes.status();
  for (const std::vector<bool>& layer : FiringHiddenNeurons(policy, *episodes)) {
    for (size_t j = 0; j < layer.size(); j += 2) EXPECT_TRUE(layer[j]) << j;
  }
}

TEST(CalibrationTest, TheLargestResidualDecidesTheFractionBitsOfAPolicyWithoutNorms) {
  ModelConfig config = SmallConfig();
  config.norm = NormKind::kNone;
  Policy policy = SmallPolicy(config, ActionSpace::Discrete(2), 1);
  policy.environment = "CartPole-v1";
  const auto episodes = PlayCalibrationEpisodes(policy);
  ASSERT_TRUE(episodes.ok()) << episodes.status();
  const float largest = LargestResidual(policy, *episodes);
  EXPECT_GT(largest, 0.0f);
  // The stream is linear in the embeddings and in the maps that are added to it.
  Policy larger = policy;
  Weights& weights = larger.weights;
  const auto scale = [](auto& values, float factor) {
    for (float& value : values) value *= factor;
  };
  const auto scale_map = [&](Linear& map) {
    scale(map.weight.values, 64.0f);
    scale(map.bias.values, 64.0f);
  };
  scale_map(weights.embed_return.linear);
  scale_map(weights.embed_state.linear);
  scale_map(weights.embed_action.linear);
  for (LayerWeights& layer : weights.layers) {
    scale(layer.coder.gain.values, 1.0f / 64.0f);
    scale_map(layer.attention_output);
    scale(layer.ffn_coder.gain.values, 1.0f / 64.0f);
    scale_map(layer.ffn_output);
  }
  scale(weights.readout_coder.gain.values, 1.0f / 64.0f);
  EXPECT_EQ(LargestResidual(larger, *episodes), 64.0f * largest);
  const auto fraction = [](const Policy& from, float residual) {
    return QuantizeToInteger(from, {.largest_residual = residual})->config.residual_fraction;
  };
  EXPECT_EQ(fraction(policy, 6.0f), 12);
  EXPECT_EQ(fraction(policy, 6.5f), 11);  // 1.25 * 6.5 exceeds 8
  EXPECT_EQ(fraction(policy, 384.0f), 6);
}

TEST(CalibrationTest, AnEnvironmentThatIsNotOursIsNotFound) {
  Policy policy = IntegerPolicy(0.0f);
  policy.environment = "Unknown-v0";
  EXPECT_TRUE(absl::IsNotFound(PlayCalibrationEpisodes(policy).status()));
}

}  // namespace
}  // namespace spikeserve
