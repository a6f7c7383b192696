#include "core/model/policy.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <memory>
#include <numbers>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/math/counter_random.h"
#include "core/model/features.h"
#include "core/model/policy_file.h"
#include "core/model/wiring_fit.h"
#include "core/model/wiring_model.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

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

TEST(ModelConfig, DefaultsAreThePapersAndValid) {
  const ModelConfig config;
  EXPECT_TRUE(config.Validate().ok());
  EXPECT_EQ(config.head_size(), 32);
  EXPECT_EQ(config.attention_inputs(), 132);
  EXPECT_EQ(config.merged_size(), 32);
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

constexpr char kText[] =
    R"({"observation": ["x", {"name": "v", "unit": "m/s", "low": -1, "high": 2.5},
  {"name": "angle", "unit": "rad", "frame": "upright"}, "rate"],
  "action": ["left", "right"], "rate_hz": 50, "rate_tolerance": 0.2})";

TEST(FeaturesTest, AFileKeepsThemAndTheModelOfTheObservations) {
  Policy policy = SmallPolicy();
  const std::string plain = *FormatPolicyFile(policy);
  EXPECT_THAT(plain, testing::Not(HasSubstr("features")));
  EXPECT_TRUE(ParsePolicyFile(plain)->features.empty());

  policy.features = *ParseFeatures(kText);
  WiringFit fit(4, 2);
  std::vector<float> observations, actions;
  for (int i = 0; i < 101 * 4; ++i) observations.push_back(static_cast<float>(i * i % 17));
  for (int i = 0; i < 100; ++i) actions.insert(actions.end(), {i % 3 ? 1.0f : 0.0f, 0.0f});
  fit.Add(observations, actions);
  policy.wiring = std::make_shared<const WiringModel>(*fit.Finish());
  const std::string named = *FormatPolicyFile(policy);
  const Policy read = *ParsePolicyFile(named);
  EXPECT_EQ(read.features, policy.features);
  EXPECT_EQ(*read.wiring, *policy.wiring);
  EXPECT_EQ(*FormatPolicyFile(read), named);
}

TEST(FeaturesTest, RefusesWhatDoesNotFitThePolicy) {
  const auto refused = [](const std::string& text) {
    auto features = ParseFeatures(text);
    if (!features.ok()) return std::string(features.status().message());
    return std::string(features->Validate(2, 2).message());
  };
  EXPECT_EQ(refused(R"({"observation": ["x"]})"),
            "features.observation: expected none or 2 elements, received 1");
  EXPECT_THAT(refused(R"({"observation": ["x", "x"]})"), HasSubstr("another name than before"));
  EXPECT_THAT(refused(R"({"observation": ["x", ""]})"), HasSubstr("[1].name: expected a name"));
  EXPECT_THAT(refused(R"({"observation": ["x", {"name": "y", "low": 1, "high": 0}]})"),
              HasSubstr("features.observation[1].high: expected at least 1, received 0"));
  EXPECT_THAT(refused(R"({"rate_hz": 0})"), HasSubstr("rate_hz: expected a positive"));
  EXPECT_THAT(refused(R"({"observations": []})"), HasSubstr("observations"));
}

TEST(FeaturesTest, UnitsAreConverted) {
  EXPECT_DOUBLE_EQ(*UnitFactor("km/h", "m/s"), 1000.0 / 3600.0);
  EXPECT_DOUBLE_EQ(*UnitFactor("kN.m", "N.m"), 1000.0);
  EXPECT_DOUBLE_EQ(*UnitFactor("cm/s2", "m/s2"), 0.01);
  EXPECT_FALSE(UnitFactor("m", "rad").has_value());
  EXPECT_FALSE(UnitFactor("furlong", "m").has_value());
}

constexpr size_t kObs = 5, kAct = 3;

std::vector<double> Draws(uint64_t seed, size_t count) {
  std::vector<double> draws;
  for (uint64_t i = 0; i < count; ++i) {
    draws.push_back(2.0 * UniformDouble(RandomBits({seed, i})) - 1.0);
  }
  return draws;
}

// The naive form of the equation in the header.
std::vector<double> Change(const WiringModel& model, const std::vector<double>& z,
                           const std::vector<float>& action) {
  std::vector<double> terms(WiringModel::Terms(kObs, kAct)), change(kObs, 0.0);
  FillWiringTerms(z, action, absl::MakeSpan(terms));
  for (size_t k = 0; k < terms.size(); ++k) {
    for (size_t i = 0; i < kObs; ++i) change[i] += model.coefficients[k * kObs + i] * terms[k];
  }
  return change;
}

TEST(WiringModelTest, MovedElementsArePredictedAsIfFromTheBeginning) {
  WiringModel model;
  model.mean.assign(kObs, 0.0);
  model.coefficients = Draws(1, WiringModel::Terms(kObs, kAct) * kObs);
  for (const std::vector<float>& action : {std::vector<float>{0.0f, 1.0f, 0.0f}, {0.3f, -1, 1}}) {
    const std::vector<double> z = Draws(2, kObs);
    std::vector<double> terms(WiringModel::Terms(kObs, kAct)), change(kObs), slopes(kObs * kObs);
    model.Predict(z, action, absl::MakeSpan(terms), absl::MakeSpan(change));
    EXPECT_EQ(change, Change(model, z, action));
    model.FillSlopes(z, action, absl::MakeSpan(slopes));
    for (size_t i = 0; i < kObs; ++i) {
      for (size_t j = i + 1; j < kObs; ++j) {
        std::vector<double> moved = z, predicted = change;
        moved[i] += 0.5;
        moved[j] -= 1.25;
        model.AddMoves(slopes, {{i, 0.5}, {j, -1.25}}, absl::MakeSpan(predicted));
        const std::vector<double> expected = Change(model, moved, action);
        for (size_t k = 0; k < kObs; ++k) EXPECT_NEAR(predicted[k], expected[k], 1e-12);
      }
    }
  }
}

}  // namespace
}  // namespace spikeserve
