#include "core/model/policy.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <numbers>
#include <string>
#include <vector>

#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

std::vector<float> AllValues(Policy policy) {
  std::vector<float> all;
  for (const TensorSlot& slot : TensorSlots(policy.config, policy.observation_size(),
                                            policy.action_space.size(), &policy.weights)) {
    all.insert(all.end(), slot.floats()->values.begin(), slot.floats()->values.end());
  }
  return all;
}

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

TEST(RandomPolicy, IsValidInEveryMode) {
  for (const Mode mode : {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull, Mode::kDense}) {
    const absl::Status status = SmallPolicy(SmallConfig(mode)).Validate();
    EXPECT_TRUE(status.ok()) << status;
  }
}

TEST(RandomPolicy, IsAFunctionOfItsSeed) {
  const auto values = [](uint64_t seed) {
    return AllValues(SmallPolicy(SmallConfig(), ActionSpace::Discrete(2), seed));
  };
  EXPECT_EQ(values(7), values(7));
  EXPECT_NE(values(7), values(8));
}

// Tensors are drawn independently, so the tensors that two modes share have equal values.
TEST(RandomPolicy, SharedTensorsAreTheSameInEveryMode) {
  EXPECT_EQ(SmallPolicy(SmallConfig(Mode::kBaseline)).weights.head.weight.values,
            SmallPolicy(SmallConfig(Mode::kFull)).weights.head.weight.values);
}

// Checks the values themselves, so that every machine and every later version draws the same ones.
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

TEST(PolicyValidate, NamesWhatIsWrong) {
  const struct {
    std::function<void(Policy&)> change;
    std::string message;
  } cases[] = {
      {[](Policy& p) { p.config.ticks = 0; }, "ticks: expected 1 to 256, received 0"},
      {[](Policy& p) { p.action_space.n = 0; }, "action_space.n: expected at least 1, received 0"},
      {[](Policy& p) { p.action_space.n = 3; },
       "tensor \"embed.action.weight\": expected shape [16, 3], received [16, 2] with 32 values"},
      {[](Policy& p) { p.weights.layers.pop_back(); }, "layers: expected 2, received weights of 1"},
      {[](Policy& p) { p.weights.observation_mean = Tensor::Zeros({0}); },
       "tensor \"observation.mean\": expected at least one value, received 0"},
      {[](Policy& p) { p.weights.head.bias.values.pop_back(); },
       "tensor \"head.bias\": expected shape [2], received [2] with 1 values"},
      {[](Policy& p) {
         p.weights.head.bias.shape = {2, 1};
       },
       "tensor \"head.bias\": expected shape [2], received [2, 1] with 2 values"},
      {[](Policy& p) { p.weights.head.weight.values[3] = kNan; },
       "tensor \"head.weight\": expected finite numbers, received nan at index 3"},
      {[](Policy& p) { p.weights.layers[1].scale.values[0] = -kInfinity; },
       "tensor \"layers.1.attention.scale\": expected finite numbers, received -inf at index 0"},
      {[](Policy& p) { p.weights.observation_std.values[1] = 0.0f; },
       "tensor \"observation.std\" at index 1: expected a positive finite number, received 0"},
      {[](Policy& p) { p.return_offset = kNan; },
       "return_offset: expected a finite number, received nan"},
      {[](Policy& p) { p.return_scale = 0.0f; },
       "return_scale: expected a positive finite number, received 0"},
      {[](Policy& p) { p.target_return = kInfinity; },
       "target_return: expected a finite number, received inf"},
      {[](Policy& p) { p.modulator_mean = kNan; },
       "modulator_mean: expected a finite number, received nan"},
      {[](Policy& p) { p.modulator_std = -1.0f; },
       "modulator_std: expected a positive finite number, received -1"},
      {[](Policy& p) { p.training = "[]"; },
       "training: expected a JSON object, received an array of 0"},
  };
  for (const auto& c : cases) {
    Policy policy = SmallPolicy();
    c.change(policy);
    const absl::Status status = policy.Validate();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << c.message;
    EXPECT_EQ(status.message(), c.message);
  }
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
