// Policy files in integer arithmetic round-trip, and invalid ones are refused with the tensor, the
// neuron and the bound.
#include <gtest/gtest.h>

#include <algorithm>
#include <functional>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "core/model/policy_file.h"
#include "core/model/safetensors.h"
#include "core/quantize/quantize_integer.h"
#include "nlohmann/json.hpp"
#include "tests/support/files.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using nlohmann::json;

template <class Typed>
auto& Numbers(Safetensors& contents, const std::string& name) {
  return std::get<Typed>(contents.tensors.at(name)).values;
}

std::function<void(Safetensors&)> SetConfig(const char* key, const json& value) {
  return [=](Safetensors& contents) {
    json config = json::parse(contents.metadata["config"]);
    config[key] = value;
    contents.metadata["config"] = config.dump();
  };
}

class IntegerPolicyFileTest : public DirectoryTest {
 protected:
  // Returns the message with which the file of a valid policy is refused after `change`, without
  // the path.
  std::string MessageAfter(const std::function<void(Safetensors&)>& change) {
    EXPECT_TRUE(WritePolicyFile(*QuantizeToInteger(SmallPolicy()), Path("good")).ok());
    Safetensors contents = *ReadSafetensors(Path("good"));
    change(contents);
    EXPECT_TRUE(WriteSafetensors(contents, Path()).ok());
    const std::string message(ReadPolicyFile(Path()).status().message());
    return message.substr(std::min(message.size(), Path().size() + 2));
  }
};

TEST_F(IntegerPolicyFileTest, TheLeakIsTheNearest) {
  for (const auto& [decay, leak] : {std::pair(0.95f, 13), {0.5f, 128}, {0.9f, 26}, {1.0f, 1}}) {
    ModelConfig config = SmallConfig();
    config.membrane_decay = decay;
    EXPECT_EQ(QuantizeToInteger(SmallPolicy(config))->config.leak(), leak) << decay;
  }
}

TEST_F(IntegerPolicyFileTest, SumsThatCanOverflowAreRefusedWithTheNeuronAndTheBound) {
  EXPECT_EQ(MessageAfter([](Safetensors& c) {
              const std::string map = "layers.0.attention.output";
              for (int j = 0; j < 8; ++j) Numbers<Int8Tensor>(c, map + ".weight")[8 + j] = 127;
              Numbers<Int8Tensor>(c, map + ".shift")[1] = -15;
              Numbers<Int16Tensor>(c, map + ".bias")[1] = 0;
            }),
            "tensor \"layers.0.attention.output.weight\": expected sums of at most 2147450880 for "
            "inputs of at most 255, received 8489533440 at index 1");
  EXPECT_EQ(MessageAfter([](Safetensors& c) {
              const std::string hidden = "layers.1.ffn.hidden";
              for (int j = 0; j < 16; ++j) Numbers<Int8Tensor>(c, hidden + ".weight")[32 + j] = 127;
              Numbers<Int16Tensor>(c, hidden + ".bias")[2] = -30736;
            }),
            "tensor \"layers.1.ffn.hidden.weight\": expected |bias| + sum of |weight| of at most "
            "32767, received 32768 at index 2");
}

TEST_F(IntegerPolicyFileTest, NumbersOutOfRangeAreRefused) {
  EXPECT_EQ(
      MessageAfter([](Safetensors& c) { Numbers<Int8Tensor>(c, "readout.coder.sign")[3] = 0; }),
      "tensor \"readout.coder.sign\": expected 1 or -1, received 0 at index 3");
  EXPECT_EQ(MessageAfter([](Safetensors& c) {
              auto& thresholds = Numbers<Int16Tensor>(c, "layers.0.coder.threshold");
              thresholds[5] = 7;
              thresholds[6] = 8;
            }),
            "tensor \"layers.0.coder.threshold\": expected at most 7, received 8 at index 6");
  EXPECT_EQ(MessageAfter(
                [](Safetensors& c) { Numbers<Int8Tensor>(c, "embed.state.norm.shift")[0] = 16; }),
            "tensor \"embed.state.norm.shift\": expected 0 to 15, received 16 at index 0");
  EXPECT_EQ(MessageAfter([](Safetensors& c) {
              Numbers<Int8Tensor>(c, "layers.0.ffn.output.shift")[2] = 32;
            }),
            "tensor \"layers.0.ffn.output.shift\": expected -15 to 31, received 32 at index 2");
}

TEST_F(IntegerPolicyFileTest, ConfigsThatTheArithmeticLacksAreRefused) {
  EXPECT_EQ(MessageAfter(SetConfig("coder", "bernoulli")),
            "config.coder: expected lif, received \"bernoulli\"");
  EXPECT_EQ(
      MessageAfter(SetConfig("membrane_decay", 0.95)),
      "membrane_decay: expected 1 - m / 256 for an m from 1 to 128 in integers, received 0.95");
  EXPECT_EQ(MessageAfter(SetConfig("leak", "none")),
            "config.leak: expected shift, received \"none\"");
  EXPECT_EQ(MessageAfter(SetConfig("attention", "linear")),
            "config.attention: expected shiftmax_by_tick or shiftmax, received \"linear\"");
  EXPECT_EQ(MessageAfter([](Safetensors& c) {
              for (const auto& [key, value] :
                   {std::pair("attention", "shiftmax"), {"merge", "concat"}, {"gate", "sigmoid"}}) {
                SetConfig(key, value)(c);
              }
            }),
            "attention: expected shiftmax_by_tick with concatenated heads and sigmoid gates, "
            "received shiftmax, which multiplied these gates by the heads; quantize the float32 "
            "policy again");
  EXPECT_EQ(MessageAfter(SetConfig("ticks", 256)), "ticks: expected 1 to 255, received 256");
  EXPECT_EQ(MessageAfter(SetConfig("input_fraction", 15)),
            "input_fraction: expected 1 to 14, received 15");
}

}  // namespace
}  // namespace spikeserve
