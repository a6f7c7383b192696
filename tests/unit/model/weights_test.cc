#include "core/model/weights.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <set>
#include <string>
#include <vector>

namespace spikeserve {
namespace {

using Shapes = std::map<std::string, std::vector<int>>;

Shapes ShapesOf(const ModelConfig& config) {
  Weights weights;
  Shapes shapes;
  std::set<Tensor*> places;
  for (const TensorSlot& slot :
       TensorSlots(config, /*observation_size=*/5, /*action_size=*/3, &weights)) {
    EXPECT_TRUE(shapes.emplace(slot.name, slot.shape).second) << slot.name;
    EXPECT_TRUE(places.insert(slot.tensor).second) << slot.name << " shares its place";
  }
  EXPECT_EQ(weights.layers.size(), static_cast<size_t>(config.layers));
  return shapes;
}

ModelConfig SmallConfig(Mode mode) {
  return {.mode = mode,
          .hidden_size = 8,
          .heads = 2,
          .layers = 1,
          .routing_hidden_size = 7,
          .ffn_size = 32};
}

// Returns the tensors that have the same shape in every mode.
Shapes CommonShapes() {
  return {
      {"embed.return.weight", {8, 1}},
      {"embed.return.bias", {8}},
      {"embed.return.norm.weight", {8}},
      {"embed.return.norm.bias", {8}},
      {"embed.state.weight", {8, 5}},
      {"embed.state.bias", {8}},
      {"embed.state.norm.weight", {8}},
      {"embed.state.norm.bias", {8}},
      {"embed.action.weight", {8, 3}},
      {"embed.action.bias", {8}},
      {"embed.action.norm.weight", {8}},
      {"embed.action.norm.bias", {8}},
      {"layers.0.attention.query.weight", {8, 8}},
      {"layers.0.attention.query.bias", {8}},
      {"layers.0.attention.key.weight", {8, 8}},
      {"layers.0.attention.key.bias", {8}},
      {"layers.0.attention.value.weight", {8, 8}},
      {"layers.0.attention.value.bias", {8}},
      {"layers.0.attention.output.weight", {8, 8}},
      {"layers.0.attention.output.bias", {8}},
      {"layers.0.attention.norm.weight", {8}},
      {"layers.0.attention.norm.bias", {8}},
      {"layers.0.ffn.hidden.weight", {32, 8}},
      {"layers.0.ffn.hidden.bias", {32}},
      {"layers.0.ffn.output.weight", {8, 32}},
      {"layers.0.ffn.output.bias", {8}},
      {"layers.0.ffn.norm.weight", {8}},
      {"layers.0.ffn.norm.bias", {8}},
      {"head.weight", {3, 8}},
      {"head.bias", {3}},
      {"observation.mean", {5}},
      {"observation.std", {5}},
  };
}

Shapes SpikingShapes() {
  Shapes shapes = CommonShapes();
  shapes["layers.0.attention.output.weight"] = {8, 4};
  for (const char* name : {"layers.0.coder", "layers.0.ffn.coder", "readout.coder"}) {
    shapes[std::string(name) + ".gain"] = {8};
    shapes[std::string(name) + ".bias"] = {8};
  }
  shapes["layers.0.attention.scale"] = {2};
  return shapes;
}

void AddPhase(Shapes* shapes) {
  (*shapes)["phase.omega"] = {2};
  (*shapes)["phase.phi"] = {2};
  for (const char* name : {"query", "key", "value"}) {
    (*shapes)["layers.0.attention." + std::string(name) + ".weight"] = {8, 10};
  }
}

void AddRouting(Shapes* shapes) {
  (*shapes)["layers.0.routing.hidden.weight"] = {7, 8};
  (*shapes)["layers.0.routing.hidden.bias"] = {7};
  (*shapes)["layers.0.routing.gate.weight"] = {2, 7};
  (*shapes)["layers.0.routing.gate.bias"] = {2};
}

TEST(TensorSlots, Baseline) { EXPECT_EQ(ShapesOf(SmallConfig(Mode::kBaseline)), SpikingShapes()); }

TEST(TensorSlots, Pos) {
  Shapes expected = SpikingShapes();
  AddPhase(&expected);
  EXPECT_EQ(ShapesOf(SmallConfig(Mode::kPos)), expected);
}

TEST(TensorSlots, Route) {
  Shapes expected = SpikingShapes();
  AddRouting(&expected);
  EXPECT_EQ(ShapesOf(SmallConfig(Mode::kRoute)), expected);
}

TEST(TensorSlots, Full) {
  Shapes expected = SpikingShapes();
  AddPhase(&expected);
  AddRouting(&expected);
  EXPECT_EQ(ShapesOf(SmallConfig(Mode::kFull)), expected);
}

TEST(TensorSlots, ConcatenatedHeadsAreAsWideAsTheToken) {
  ModelConfig config = SmallConfig(Mode::kBaseline);
  config.merge = Merge::kConcat;
  Shapes expected = SpikingShapes();
  expected["layers.0.attention.output.weight"] = {8, 8};
  EXPECT_EQ(ShapesOf(config), expected);
}

TEST(TensorSlots, DenseHasTimestepsAndNoNeurons) {
  Shapes expected = CommonShapes();
  expected["embed.timestep.weight"] = {-1, 8};
  EXPECT_EQ(ShapesOf(SmallConfig(Mode::kDense)), expected);
}

TEST(TensorSlots, EveryLayerHasItsOwn) {
  ModelConfig config = SmallConfig(Mode::kFull);
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
