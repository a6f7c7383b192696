#include "core/model/policy_file.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <bit>
#include <cmath>
#include <limits>
#include <string>
#include <variant>
#include <vector>

#include "core/model/safetensors.h"
#include "core/quantize/quantize_integer.h"
#include "nlohmann/json.hpp"
#include "tests/support/files.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using nlohmann::json;
using testing::HasSubstr;
using testing::StartsWith;

using PolicyFileTest = DirectoryTest;

// Returns the bits of the values: unlike ==, these distinguish 0 from -0.
std::vector<uint32_t> Bits(const std::vector<float>& values) {
  std::vector<uint32_t> bits;
  for (const float value : values) bits.push_back(std::bit_cast<uint32_t>(value));
  return bits;
}
template <class Integer>
std::vector<uint32_t> Bits(const std::vector<Integer>& values) {
  return {values.begin(), values.end()};
}

void ExpectBitEqual(Policy a, Policy b) {
  EXPECT_EQ(a.config, b.config);
  EXPECT_EQ(a.action_space, b.action_space);
  EXPECT_EQ(a.environment, b.environment);
  EXPECT_EQ(a.training, b.training);
  EXPECT_EQ(
      Bits({a.return_offset, a.return_scale, a.target_return, a.modulator_mean, a.modulator_std}),
      Bits({b.return_offset, b.return_scale, b.target_return, b.modulator_mean, b.modulator_std}));
  const auto slots = [](Policy& policy) {
    return TensorSlots(policy.config, policy.observation_size(), policy.action_space.size(),
                       &policy.weights);
  };
  const std::vector<TensorSlot> a_slots = slots(a), b_slots = slots(b);
  ASSERT_EQ(a_slots.size(), b_slots.size());
  for (size_t i = 0; i < a_slots.size(); ++i) {
    std::visit(
        [&](const auto* a_tensor, const auto* b_tensor) {
          EXPECT_EQ(a_tensor->shape, b_tensor->shape) << a_slots[i].name;
          EXPECT_EQ(Bits(a_tensor->values), Bits(b_tensor->values)) << a_slots[i].name;
        },
        a_slots[i].tensor, b_slots[i].tensor);
  }
}

void ExpectRoundTrip(const Policy& policy, const std::string& path) {
  const absl::Status written = WritePolicyFile(policy, path);
  ASSERT_TRUE(written.ok()) << written;
  const auto read = ReadPolicyFile(path);
  ASSERT_TRUE(read.ok()) << read.status();
  ExpectBitEqual(policy, *read);
}

TEST_F(PolicyFileTest, EveryShapeRoundTripsBitForBit) {
  for (const Mode mode : {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull, Mode::kDense}) {
    for (const Merge merge : {Merge::kSum, Merge::kConcat}) {
      for (const Gate gate : {Gate::kSoftmax, Gate::kSigmoid}) {
        for (const ActionSpace& space :
             {ActionSpace::Discrete(3), ActionSpace::Box({-2.0f, 0.1f}, {2.0f, 0.3f})}) {
          ModelConfig config = SmallConfig(mode);
          config.merge = merge;
          config.gate = gate;
          ExpectRoundTrip(SmallPolicy(config, space), Path());
        }
      }
    }
  }
}

TEST_F(PolicyFileTest, IntegerPoliciesRoundTripBitForBit) {
  for (const Mode mode : {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull}) {
    for (const Merge merge : {Merge::kSum, Merge::kConcat}) {
      ModelConfig config = SmallConfig(mode);
      config.merge = merge;
      ExpectRoundTrip(*QuantizeToInteger(SmallPolicy(config)), Path());
    }
  }
}

TEST_F(PolicyFileTest, PoliciesWithoutNormsRoundTripBitForBit) {
  for (const Mode mode : {Mode::kBaseline, Mode::kFull}) {
    ModelConfig config = SmallConfig(mode);
    config.norm = NormKind::kNone;
    const Policy policy = SmallPolicy(config);
    ExpectRoundTrip(policy, Path());
    EXPECT_THAT(*FormatPolicyFile(policy), testing::Not(HasSubstr(".norm.")));
    ExpectRoundTrip(*QuantizeToInteger(policy), Path());
  }
}

TEST_F(PolicyFileTest, EveryFieldRoundTripsBitForBit) {
  ModelConfig config = SmallConfig();
  config.layers = 3;
  config.membrane_decay = std::nextafter(0.9f, 1.0f);
  config.threshold = 1.0f / 3.0f;
  config.phase_clock = PhaseClock::kWindow;
  Policy policy = SmallPolicy(config);
  policy.return_offset = -0.0f;
  policy.return_scale = std::numeric_limits<float>::denorm_min();
  policy.target_return = -std::numeric_limits<float>::max();
  policy.modulator_mean = std::nextafter(0.1f, 1.0f);
  policy.modulator_std = 1.0e-10f;
  policy.environment = "Größe \"1\"";
  policy.training = R"({"command": "a \"b\"", "evaluation": {"mean_return": 500.0}})";
  policy.weights.head.bias.values = {-0.0f, std::numeric_limits<float>::denorm_min()};
  ExpectRoundTrip(policy, Path());
}

TEST_F(PolicyFileTest, ObservationChangesComeWithTheirScales) {
  ModelConfig config = SmallConfig();
  config.observation_changes = true;
  Policy policy = SmallPolicy(config);
  policy.weights.observation_change_std.values = {0.1f, 1.0f, 2.0f, 3.0f};
  ExpectRoundTrip(policy, Path());
  const auto contents = ReadSafetensors(Path());
  ASSERT_TRUE(contents.ok());
  EXPECT_EQ(json::parse(contents->metadata.at("config"))["observation_changes"], true);
  EXPECT_EQ(std::get<Tensor>(contents->tensors.at("embed.state.weight")).shape,
            (std::vector<int>{16, 8}));
  EXPECT_EQ(std::get<Tensor>(contents->tensors.at("observation.change_std")).values,
            policy.weights.observation_change_std.values);
}

TEST_F(PolicyFileTest, WhatIsWrittenIsTheSameEveryTime) {
  ASSERT_TRUE(WritePolicyFile(SmallPolicy(), Path("a")).ok());
  ASSERT_TRUE(WritePolicyFile(SmallPolicy(), Path("b")).ok());
  EXPECT_EQ(ReadBytes(Path("a")), ReadBytes(Path("b")));
}

TEST_F(PolicyFileTest, MetadataIsReadableByOthers) {
  Policy policy = SmallPolicy();
  policy.return_offset = 0.1f;
  ASSERT_TRUE(WritePolicyFile(policy, Path()).ok());
  const auto contents = ReadSafetensors(Path());
  ASSERT_TRUE(contents.ok());
  EXPECT_EQ(contents->metadata.at("format"), "spikeserve.policy.v1");
  EXPECT_EQ(contents->metadata.at("return_offset"), "0.1");
  EXPECT_EQ(contents->metadata.at("action_space"), R"({"type":"Discrete","n":2})");
  const json config = json::parse(contents->metadata.at("config"));
  EXPECT_EQ(config["mode"], "full");
  EXPECT_EQ(config["hidden_size"], 16);
  EXPECT_EQ(config.size(), 14u) << "no other keys, so that older versions can read it";
}

TEST_F(PolicyFileTest, IntegerTensorsHaveTheDtypesThatOthersExpect) {
  ASSERT_TRUE(WritePolicyFile(*QuantizeToInteger(SmallPolicy()), Path()).ok());
  const auto contents = ReadSafetensors(Path());
  ASSERT_TRUE(contents.ok());
  EXPECT_EQ(json::parse(contents->metadata.at("config"))["arithmetic"], "integer");
  const auto dtype = [&](const char* name) { return DtypeName(contents->tensors.at(name)); };
  EXPECT_EQ(dtype("layers.1.attention.query.weight"), "I8");
  EXPECT_EQ(dtype("layers.1.attention.query.scale"), "F32");
  EXPECT_EQ(dtype("layers.1.attention.query.bias"), "I16");
  EXPECT_EQ(dtype("layers.1.attention.query.threshold"), "I16");
  EXPECT_EQ(dtype("layers.1.attention.scale"), "I16");
  EXPECT_EQ(dtype("layers.1.ffn.output.weight"), "I8");
  EXPECT_EQ(dtype("layers.1.ffn.output.bias"), "I16");
  EXPECT_EQ(dtype("head.weight"), "F32");
}

TEST_F(PolicyFileTest, OtherAnnotationsAreLeftAlone) {
  ASSERT_TRUE(WritePolicyFile(SmallPolicy(), Path()).ok());
  auto contents = ReadSafetensors(Path());
  contents->metadata["author"] = "someone";
  ASSERT_TRUE(WriteSafetensors(*contents, Path()).ok());
  EXPECT_TRUE(ReadPolicyFile(Path()).ok());
}

TEST_F(PolicyFileTest, AMissingFileIsNotFound) {
  const absl::Status status = ReadPolicyFile(Path()).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(status.message(), Path() + ": no such file");
}

TEST_F(PolicyFileTest, ABrokenContainerIsRefusedWithThePath) {
  WriteBytes(Path(), "short");
  const absl::Status status = ReadPolicyFile(Path()).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(status.message()), StartsWith(Path() + ": file size: expected 8"));
}

TEST_F(PolicyFileTest, AnInvalidPolicyIsNotWritten) {
  WriteBytes(Path(), "as it was");
  Policy policy = SmallPolicy();
  policy.weights.head.weight.values[0] = NAN;
  const absl::Status status = WritePolicyFile(policy, Path());
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(status.message()), StartsWith(Path() + ": tensor \"head.weight\""));
  EXPECT_EQ(ReadBytes(Path()), "as it was");
}

}  // namespace
}  // namespace spikeserve
