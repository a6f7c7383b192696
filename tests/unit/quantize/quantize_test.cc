// Tests how a float32 policy becomes one in integers: its populations (round_fixed_point.h), and
// what is refused.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>
#include <string>

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

}  // namespace
}  // namespace spikeserve
