#include "core/model/policy.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

double Mean(const std::vector<float>& values) {
  double sum = 0.0;
  for (const float value : values) sum += value;
  return sum / static_cast<double>(values.size());
}

double Deviation(const std::vector<float>& values) {
  const double mean = Mean(values);
  double sum = 0.0;
  for (const float value : values) sum += (value - mean) * (value - mean);
  return std::sqrt(sum / static_cast<double>(values.size()));
}

// Checks the values themselves, so that every machine and every later version draws the same ones.
TEST(ModelConfig, DefaultsAreThePapersAndValid) {
  const ModelConfig config;
  EXPECT_TRUE(config.Validate().ok());
  EXPECT_EQ(config.head_size(), 32);
  EXPECT_EQ(config.attention_inputs(), 132);
  EXPECT_EQ(config.merged_size(), 32);
}

TEST(RandomPolicy, DrawsTheSameNumbersEverywhere) {
  ModelConfig config = SmallConfig();
  config.heads = 4;
  const Weights weights = SmallPolicy(config).weights;
  EXPECT_EQ(weights.head.weight.values[0], -0x1.b9c0e6p-5f);
  EXPECT_EQ(weights.layers[1].query.weight.values[19], 0x1.a3615p-5f);
  EXPECT_EQ(weights.phase_omega.values[3], 0x1.0e8bbp+1f);
}

TEST(RandomPolicy, FollowsTheInitialisationThatTrains) {
  const Policy policy =
      RandomPolicy(ModelConfig(), /*observation_size=*/4, ActionSpace::Discrete(2), 3);
  const LayerWeights& layer = policy.weights.layers[0];
  EXPECT_NEAR(Mean(layer.query.weight.values), 0.0, 1e-3);
  EXPECT_NEAR(Deviation(layer.query.weight.values), 0.3 / std::sqrt(132.0), 5e-4);
  EXPECT_NEAR(Deviation(layer.ffn_hidden.weight.values), 0.3 / std::sqrt(128.0), 5e-4);
  EXPECT_EQ(layer.value.bias.values, std::vector<float>(128, 0.1f));
  EXPECT_EQ(layer.ffn_hidden.bias.values, std::vector<float>(512, 0.1f));
  EXPECT_EQ(layer.coder.gain.values, std::vector<float>(128, 0.5f));
  EXPECT_EQ(policy.weights.readout_coder.bias.values, std::vector<float>(128, 0.2f));
  EXPECT_EQ(layer.ffn_norm.weight.values, std::vector<float>(128, 1.0f));
  EXPECT_EQ(layer.scale.values, std::vector<float>(4, static_cast<float>(1 / std::sqrt(32.0))));
  EXPECT_NEAR(Deviation(layer.ffn_output.weight.values), 1.0 / std::sqrt(3.0 * 512.0), 5e-4);
  for (const float value : layer.ffn_output.bias.values) {
    EXPECT_LE(std::abs(value), 1.0 / std::sqrt(512.0));
  }
  for (const float omega : policy.weights.phase_omega.values) {
    EXPECT_GE(omega, 0.1f);
    EXPECT_LE(omega, 10.0f);
  }
  for (const float phi : policy.weights.phase_phi.values) {
    EXPECT_GE(phi, 0.0f);
    EXPECT_LE(phi, static_cast<float>(2.0 * std::numbers::pi));
  }
}

TEST(RandomPolicy, ADenseModelHasNoNeuronsToFeed) {
  const Policy policy = SmallPolicy(SmallConfig(Mode::kDense));
  EXPECT_EQ(policy.weights.embed_timestep.shape, (std::vector<int>{kDenseTimesteps, 16}));
  EXPECT_NE(policy.weights.layers[0].query.bias.values, std::vector<float>(16, 0.1f));
}

// What a file can hold is refused in policy_file_refusal_test.cc.
TEST(PolicyValidate, NamesALayerThatIsMissing) {
  Policy policy = SmallPolicy();
  policy.weights.layers.pop_back();
  EXPECT_EQ(policy.Validate(),
            absl::InvalidArgumentError("layers: expected 2, received weights of 1"));
}

TEST(TrainingReturn, IsTheStoredEvaluationsMean) {
  Policy policy;
  policy.training = R"({"seed": 1, "evaluation": {"mean_return": -97.5, "episodes": 20}})";
  EXPECT_EQ(TrainingReturn(policy), -97.5);
}

TEST(TrainingReturn, IsAbsentWhereNothingIsStored) {
  for (const char* training :
       {"{}", R"({"evaluation": {}})", R"({"evaluation": []})", R"({"evaluation": 3})",
        R"({"evaluation": {"mean_return": "high"}})", "not JSON"}) {
    Policy policy;
    policy.training = training;
    EXPECT_EQ(TrainingReturn(policy), std::nullopt) << training;
  }
}

}  // namespace
}  // namespace spikeserve
