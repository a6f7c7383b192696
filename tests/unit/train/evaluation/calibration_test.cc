#include "train/evaluation/calibration.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <memory>

#include "core/engine/factory/engine_factory.h"
#include "core/quantize/prune_hidden.h"
#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"
#include "train/data/dataset.h"

namespace spikeserve {
namespace {

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
