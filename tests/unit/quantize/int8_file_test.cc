// Converts policies with 8-bit weights that release 0.1.0 left behind.
#include "core/quantize/int8_file.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <string>

#include "core/model/policy_file.h"
#include "core/model/safetensors.h"
#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

std::string Released(const std::string& version) {
  return RELEASED_POLICIES + version + "/policy.safetensors";
}

const Int8Tensor& Levels(const Safetensors& contents, const std::string& name) {
  return std::get<Int8Tensor>(contents.tensors.at(name));
}

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
