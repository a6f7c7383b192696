#include "core/model/weights.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <set>
#include <string>
#include <vector>

#include "tests/support/small_config.h"

namespace spikeserve {
namespace {

using Shapes = std::map<std::string, std::vector<int>>;

Shapes ShapesOf(const ModelConfig& config) {
  Weights weights;
  Shapes shapes;
  std::set<decltype(TensorSlot::tensor)> places;
  for (const TensorSlot& slot :
       TensorSlots(config, /*observation_size=*/5, /*action_size=*/3, &weights)) {
    EXPECT_TRUE(shapes.emplace(slot.name, slot.shape).second) << slot.name;
    EXPECT_TRUE(places.insert(slot.tensor).second) << slot.name << " shares its place";
  }
  EXPECT_EQ(weights.layers.size(), static_cast<size_t>(config.layers));
  return shapes;
}

ModelConfig OneLayer(Mode mode) {
  ModelConfig config = SmallConfig(mode);
  config.layers = 1;
  return config;
}

// Returns the tensors that have the same shape in every mode.
Shapes CommonShapes() {
  return {
      {"embed.return.weight", {16, 1}},
      {"embed.return.bias", {16}},
      {"embed.return.norm.weight", {16}},
      {"embed.return.norm.bias", {16}},
      {"embed.state.weight", {16, 5}},
      {"embed.state.bias", {16}},
      {"embed.state.norm.weight", {16}},
      {"embed.state.norm.bias", {16}},
      {"embed.action.weight", {16, 3}},
      {"embed.action.bias", {16}},
      {"embed.action.norm.weight", {16}},
      {"embed.action.norm.bias", {16}},
      {"layers.0.attention.query.weight", {16, 16}},
      {"layers.0.attention.query.bias", {16}},
      {"layers.0.attention.key.weight", {16, 16}},
      {"layers.0.attention.key.bias", {16}},
      {"layers.0.attention.value.weight", {16, 16}},
      {"layers.0.attention.value.bias", {16}},
      {"layers.0.attention.output.weight", {16, 16}},
      {"layers.0.attention.output.bias", {16}},
      {"layers.0.attention.norm.weight", {16}},
      {"layers.0.attention.norm.bias", {16}},
      {"layers.0.ffn.hidden.weight", {32, 16}},
      {"layers.0.ffn.hidden.bias", {32}},
      {"layers.0.ffn.output.weight", {16, 32}},
      {"layers.0.ffn.output.bias", {16}},
      {"layers.0.ffn.norm.weight", {16}},
      {"layers.0.ffn.norm.bias", {16}},
      {"head.weight", {3, 16}},
      {"head.bias", {3}},
      {"observation.mean", {5}},
      {"observation.std", {5}},
  };
}

Shapes SpikingShapes() {
  Shapes shapes = CommonShapes();
  shapes["layers.0.attention.output.weight"] = {16, 8};
  for (const char* name : {"layers.0.coder", "layers.0.ffn.coder", "readout.coder"}) {
    shapes[std::string(name) + ".gain"] = {16};
    shapes[std::string(name) + ".bias"] = {16};
  }
  shapes["layers.0.attention.scale"] = {2};
  return shapes;
}

void AddPhase(Shapes* shapes) {
  (*shapes)["phase.omega"] = {2};
  (*shapes)["phase.phi"] = {2};
  for (const char* name : {"query", "key", "value"}) {
    (*shapes)["layers.0.attention." + std::string(name) + ".weight"] = {16, 18};
  }
}

void AddRouting(Shapes* shapes) {
  (*shapes)["layers.0.routing.hidden.weight"] = {4, 16};
  (*shapes)["layers.0.routing.hidden.bias"] = {4};
  (*shapes)["layers.0.routing.gate.weight"] = {2, 4};
  (*shapes)["layers.0.routing.gate.bias"] = {2};
}

TEST(TensorSlots, Baseline) { EXPECT_EQ(ShapesOf(OneLayer(Mode::kBaseline)), SpikingShapes()); }

TEST(TensorSlots, Pos) {
  Shapes expected = SpikingShapes();
  AddPhase(&expected);
  EXPECT_EQ(ShapesOf(OneLayer(Mode::kPos)), expected);
}

TEST(TensorSlots, Route) {
  Shapes expected = SpikingShapes();
  AddRouting(&expected);
  EXPECT_EQ(ShapesOf(OneLayer(Mode::kRoute)), expected);
}

TEST(TensorSlots, Full) {
  Shapes expected = SpikingShapes();
  AddPhase(&expected);
  AddRouting(&expected);
  EXPECT_EQ(ShapesOf(OneLayer(Mode::kFull)), expected);
}

TEST(TensorSlots, ConcatenatedHeadsAreAsWideAsTheToken) {
  ModelConfig config = OneLayer(Mode::kBaseline);
  config.merge = Merge::kConcat;
  Shapes expected = SpikingShapes();
  expected["layers.0.attention.output.weight"] = {16, 16};
  EXPECT_EQ(ShapesOf(config), expected);
}

TEST(TensorSlots, DenseHasTimestepsAndNoNeurons) {
  Shapes expected = CommonShapes();
  expected["embed.timestep.weight"] = {-1, 16};
  EXPECT_EQ(ShapesOf(OneLayer(Mode::kDense)), expected);
}

TEST(TensorSlots, EveryLayerHasItsOwn) {
  ModelConfig config = OneLayer(Mode::kFull);
  const size_t one = ShapesOf(config).size();
  config.layers = 3;
  const Shapes shapes = ShapesOf(config);
  EXPECT_EQ(shapes.count("layers.2.ffn.coder.gain"), 1u);
  EXPECT_EQ(shapes.size(), one + 2 * 25);
}

TEST(Tensor, ZerosAreRowMajor) {
  Tensor tensor = Tensor::Zeros({2, 3});
  ASSERT_EQ(tensor.values.size(), 6u);
  tensor.values[5] = 1.0f;
  EXPECT_EQ(tensor.at(1, 2), 1.0f);
  EXPECT_EQ(tensor.at(0, 2), 0.0f);
}

}  // namespace
}  // namespace spikeserve
