// Tests how a float32 policy becomes one in integers: its populations (round_fixed_point.h), and
// what is refused.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>

#include "core/model/policy_file.h"
#include "core/model/safetensors.h"
#include "core/quantize/int8_file.h"
#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using testing::Each;
using testing::ElementsAre;

// Returns a copy of a row of a matrix.
template <class Number>
std::vector<Number> Row(const BasicTensor<Number>& tensor, int row) {
  const auto begin = tensor.values.begin() + row * tensor.shape[1];
  return {begin, begin + tensor.shape[1]};
}

void SetRow(Tensor& tensor, int row, const std::vector<float>& values) {
  for (size_t j = 0; j < static_cast<size_t>(tensor.shape[1]); ++j) {
    tensor.values[static_cast<size_t>(row) * tensor.shape[1] + j] =
        j < values.size() ? values[j] : 0.0f;
  }
}

ModelConfig TinyConfig() {
  ModelConfig config = SmallConfig(Mode::kBaseline);
  config.hidden_size = 4;
  config.layers = 1;
  config.ffn_size = 4;
  return config;
}

TEST(QuantizeToInteger, RoundsToTheNearestLevelOfEachNeuron) {
  Policy policy = SmallPolicy(TinyConfig());
  Linear& query = policy.weights.layers[0].query;
  SetRow(query.weight, 0, {127.0f, 1.5f, 2.5f, -0.5f});  // a scale of 1; ties
  SetRow(query.weight, 1, {-1.0f, 0.5f, 0.25f, 0.0f});   // a scale of 1 / 127
  query.bias.values = {-3.5f, 0.1f, 0.0f, 0.0f};
  const IntegerPopulation integer = QuantizeToInteger(policy)->weights.layers[0].integer.query;
  EXPECT_THAT(Row(integer.weight, 0), ElementsAre(127, 2, 2, 0));
  EXPECT_EQ(integer.scale.values[0], 1.0f);
  EXPECT_EQ(integer.bias.values[0], -4);
  EXPECT_EQ(integer.threshold.values[0], 1);
  EXPECT_THAT(Row(integer.weight, 1), ElementsAre(-127, 64, 32, 0));
  EXPECT_EQ(integer.scale.values[1], 1.0f / 127.0f);
  EXPECT_EQ(integer.bias.values[1], 13);
  EXPECT_EQ(integer.threshold.values[1], 127);
}

TEST(QuantizeToInteger, TheLeakIsTheNearest) {
  for (const auto& [decay, leak] : {std::pair(0.95f, 13), {0.5f, 128}, {0.9f, 26}, {1.0f, 1}}) {
    ModelConfig config = SmallConfig();
    config.membrane_decay = decay;
    EXPECT_EQ(QuantizeToInteger(SmallPolicy(config))->config.leak(), leak) << decay;
  }
}

TEST(QuantizeToInteger, AThresholdIsAtLeastOneUnitAndAtMost16384) {
  Policy policy = SmallPolicy(TinyConfig());
  Linear& hidden = policy.weights.layers[0].ffn_hidden;
  SetRow(hidden.weight, 0, {12700.0f});  // the threshold of 1 is 0.01 units
  SetRow(hidden.weight, 1, {1e-9f});
  SetRow(hidden.weight, 2, {});
  const IntegerPopulation integer = QuantizeToInteger(policy)->weights.layers[0].integer.ffn_hidden;
  EXPECT_EQ(integer.threshold.values[0], 1);
  EXPECT_EQ(integer.threshold.values[1], 16384);
  EXPECT_EQ(integer.threshold.values[2], 16384);
  EXPECT_EQ(integer.scale.values[2], 1.0f / 16384.0f);
  EXPECT_THAT(Row(integer.weight, 1), Each(0));
}

TEST(QuantizeToInteger, TheHeadStaysAsItIsAndFloat32MapsAreGone) {
  const Policy policy = SmallPolicy();
  const absl::StatusOr<Policy> integer = QuantizeToInteger(policy);
  ASSERT_TRUE(integer.ok()) << integer.status();
  EXPECT_EQ(integer->config.arithmetic, Arithmetic::kInteger);
  EXPECT_EQ(integer->weights.head.weight.values, policy.weights.head.weight.values);
  EXPECT_TRUE(integer->weights.layers[1].query.weight.values.empty());
  EXPECT_TRUE(integer->weights.layers[1].ffn_output.bias.values.empty());
}

std::string Refusal(const Policy& policy) {
  const absl::Status status = QuantizeToInteger(policy).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  return std::string(status.message());
}

TEST(QuantizeToInteger, RefusesWhatIntegersCannotHold) {
  EXPECT_EQ(Refusal(*QuantizeToInteger(SmallPolicy())),
            "arithmetic: expected float32, received integer");
  Policy policy = SmallPolicy(TinyConfig());
  SetRow(policy.weights.layers[0].key.weight, 3, {127.0f});  // a scale of 1
  policy.weights.layers[0].key.bias.values[3] = 32768.0f;
  EXPECT_EQ(Refusal(policy),
            "tensor \"layers.0.attention.key.bias\": expected at most 32767 units of 1, received "
            "32768 at index 3");
  policy.weights.layers[0].key.bias.values[3] = -32767.0f;
  EXPECT_EQ(Refusal(policy),
            "tensor \"layers.0.attention.key.weight\": expected |bias| + sum of |weight| of at "
            "most 32767, received 32894 at index 3");
  policy.weights.layers[0].key.bias.values[3] = -32640.0f;
  EXPECT_TRUE(QuantizeToInteger(policy).ok()) << QuantizeToInteger(policy).status();

  policy.weights.head.bias.values[0] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(Refusal(policy),
            "tensor \"head.bias\": expected finite numbers, received nan at index 0");
}

using testing::HasSubstr;

std::string Released(const std::string& version) {
  return RELEASED_POLICIES + version + "/policy.safetensors";
}

const Int8Tensor& Levels(const Safetensors& contents, const std::string& name) {
  return std::get<Int8Tensor>(contents.tensors.at(name));
}

// Converts policies with 8-bit weights that release 0.1.0 left behind.
class Int8FileTest : public testing::Test {
 protected:
  // Writes the file of a release with a change, and returns what its reader says.
  std::string RefusalOf(void (*change)(Safetensors&)) {
    Safetensors contents = *ReadSafetensors(Released("cartpole-sparse/2"));
    change(contents);
    const std::string path = testing::TempDir() + "/changed.safetensors";
    EXPECT_TRUE(WriteSafetensors(contents, path).ok());
    const absl::Status status = ReadConvertiblePolicy(path).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(status.message()), testing::StartsWith(path + ": "));
    return std::string(status.message());
  }
};

TEST_F(Int8FileTest, TheServersReaderNamesTheCommand) {
  for (const char* version : {"cartpole-sparse/2", "cartpole-frugal/2"}) {
    const absl::Status status = ReadPolicyFile(Released(version)).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(status.message()),
                HasSubstr("received int8, which is no longer served: `spiketrain quantize "));
  }
}

// A neuron of the file fires where its sum reaches the threshold, one of float32 where it reaches
// that of the config.
TEST_F(Int8FileTest, NeuronsFireAtTheSameSums) {
  const Safetensors before = *ReadSafetensors(Released("cartpole-sparse/2"));
  const absl::StatusOr<ConvertiblePolicy> read =
      ReadConvertiblePolicy(Released("cartpole-sparse/2"));
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_TRUE(read->was_int8);
  EXPECT_EQ(read->policy.config.arithmetic, Arithmetic::kFloat32);
  ASSERT_TRUE(read->policy.Validate().ok());
  const Linear& query = read->policy.weights.layers[0].query;
  const std::string name = "layers.0.attention.query";
  const Int8Tensor& levels = Levels(before, name + ".weight");
  const auto& thresholds = std::get<Int16Tensor>(before.tensors.at(name + ".threshold"));
  const float threshold = read->policy.config.threshold;
  for (int k = 0; k < levels.shape[0]; ++k) {
    const auto level = static_cast<float>(thresholds.values[k]);
    float unit = 0.0f;
    for (int j = 0; j < levels.shape[1]; ++j) {
      if (levels.at(k, j) != 0) unit = query.weight.at(k, j) / static_cast<float>(levels.at(k, j));
    }
    if (unit == 0.0f) continue;
    EXPECT_GE(unit * level, threshold) << "neuron " << k;
    EXPECT_LT(unit * (level - 0.5f), threshold) << "neuron " << k;
  }
}

TEST_F(Int8FileTest, RoundingGivesTheLevelsOfTheFileAgain) {
  for (const char* version : {"cartpole-sparse/2", "cartpole-frugal/2"}) {
    const Safetensors before = *ReadSafetensors(Released(version));
    const auto read = ReadConvertiblePolicy(Released(version));
    ASSERT_TRUE(read.ok()) << read.status();
    const auto integer = QuantizeToInteger(read->policy);
    ASSERT_TRUE(integer.ok()) << integer.status();
    const IntegerMaps& maps = integer->weights.layers[0].integer;
    for (const auto& [name, map] : {std::pair("attention.query", &maps.query),
                                    {"attention.key", &maps.key},
                                    {"attention.value", &maps.value},
                                    {"ffn.hidden", &maps.ffn_hidden}}) {
      const std::string prefix = "layers.0." + std::string(name);
      const auto levels = [&](const char* part) {
        return std::get<Int16Tensor>(before.tensors.at(prefix + part)).values;
      };
      EXPECT_EQ(map->weight.values, Levels(before, prefix + ".weight").values) << prefix;
      EXPECT_EQ(map->threshold.values, levels(".threshold")) << prefix;
      EXPECT_EQ(map->bias.values, levels(".bias")) << prefix;
    }
  }
}

TEST_F(Int8FileTest, OtherPoliciesAreReadAsTheyAre) {
  const auto float32 = ReadConvertiblePolicy(Released("cartpole-sparse/1"));
  ASSERT_TRUE(float32.ok()) << float32.status();
  EXPECT_FALSE(float32->was_int8);
  EXPECT_EQ(*FormatPolicyFile(float32->policy),
            *FormatPolicyFile(*ReadPolicyFile(Released("cartpole-sparse/1"))));
}

TEST_F(Int8FileTest, DamagedFilesAreRefusedByTensor) {
  EXPECT_THAT(RefusalOf([](Safetensors& c) { c.tensors.erase("layers.0.ffn.hidden.scale"); }),
              HasSubstr("tensor \"layers.0.ffn.hidden.scale\": expected 128 numbers of dtype F32"));
  EXPECT_THAT(RefusalOf([](Safetensors& c) {
                c.tensors["layers.0.attention.key.threshold"] = Int16Tensor::Zeros({31});
              }),
              HasSubstr("tensor \"layers.0.attention.key.threshold\": expected 32 numbers"));
  EXPECT_THAT(RefusalOf([](Safetensors& c) {
                c.tensors["layers.0.ffn.output.weight"] = Int8Tensor::Zeros({4});
              }),
              HasSubstr("tensor \"layers.0.ffn.output.weight\": expected a matrix, received 1"));
  EXPECT_THAT(RefusalOf([](Safetensors& c) { c.metadata["config"] = "{\"arithmetic\":\"int8\"}"; }),
              HasSubstr("config: expected key \"mode\", received none"));
  EXPECT_THAT(ReadConvertiblePolicy("none.safetensors").status().message(),
              HasSubstr("none.safetensors: no such file"));
}

}  // namespace
}  // namespace spikeserve
