// Invalid policy files are refused with the path, the field, what was expected and what was
// received.
#include <gtest/gtest.h>

#include <functional>
#include <limits>
#include <string>
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

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

// A change that makes a valid policy file invalid, and the message of the error, without the path.
struct Refusal {
  std::function<void(Safetensors&)> change;
  std::string message;
};

// Returns the change that sets `key` of the config.
std::function<void(Safetensors&)> SetConfig(const std::string& key, const json& value) {
  return [=](Safetensors& contents) {
    json config = json::parse(contents.metadata["config"]);
    config[key] = value;
    contents.metadata["config"] = config.dump();
  };
}

template <class Typed = Tensor>
auto& Numbers(Safetensors& contents, const std::string& name) {
  return std::get<Typed>(contents.tensors.at(name)).values;
}

class PolicyFileRefusalTest : public DirectoryTest {
 protected:
  void ExpectRefused(const std::vector<Refusal>& refusals, const Policy& policy = SmallPolicy()) {
    ASSERT_TRUE(WritePolicyFile(policy, Path("good")).ok());
    for (const Refusal& refusal : refusals) {
      Safetensors contents = *ReadSafetensors(Path("good"));
      refusal.change(contents);
      ASSERT_TRUE(WriteSafetensors(contents, Path()).ok());
      const absl::Status status = ReadPolicyFile(Path()).status();
      EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << refusal.message;
      EXPECT_EQ(status.message(), Path() + ": " + refusal.message);
    }
  }
};

TEST_F(PolicyFileRefusalTest, Tensors) {
  ExpectRefused({
      {[](auto& c) { c.tensors.erase("head.bias"); },
       "tensor \"head.bias\": expected, but missing"},
      {[](auto& c) { c.tensors.erase("layers.1.routing.gate.weight"); },
       "tensor \"layers.1.routing.gate.weight\": expected, but missing"},
      {[](auto& c) { c.tensors.erase("observation.mean"); },
       "tensor \"observation.mean\": expected, but missing"},
      {[](auto& c) {
         c.tensors["embed.timestep.weight"] = Tensor::Zeros({4, 16});
       },
       "tensor \"embed.timestep.weight\": not expected in a policy of mode full in float32"},
      {[](auto& c) { c.tensors["layers.2.coder.gain"] = Tensor::Zeros({16}); },
       "tensor \"layers.2.coder.gain\": not expected in a policy of mode full in float32"},
      {[](auto& c) {
         c.tensors["head.weight"] = Tensor::Zeros({16, 2});
       },
       "tensor \"head.weight\": expected shape [2, 16], received [16, 2] with 32 values"},
      {[](auto& c) { c.tensors["head.bias"] = Tensor::Zeros({}); },
       "tensor \"head.bias\": expected shape [2], received [] with 1 values"},
      {[](auto& c) { c.tensors["observation.mean"] = Tensor::Zeros({0}); },
       "tensor \"observation.mean\": expected at least one value, received 0"},
      {[](auto& c) { c.tensors["observation.mean"] = Tensor::Zeros({5}); },
       "tensor \"embed.state.weight\": expected shape [16, 5], received [16, 4] with 64 values"},
      {[](auto& c) { Numbers(c, "layers.0.attention.query.weight")[7] = kNan; },
       "tensor \"layers.0.attention.query.weight\": expected finite numbers, received nan at index "
       "7"},
      {[](auto& c) { Numbers(c, "phase.omega")[1] = kInfinity; },
       "tensor \"phase.omega\": expected finite numbers, received inf at index 1"},
      {[](auto& c) { Numbers(c, "observation.std")[2] = -1.0f; },
       "tensor \"observation.std\" at index 2: expected a positive finite number, received -1"},
  });
}

TEST_F(PolicyFileRefusalTest, ObservationChanges) {
  ExpectRefused({{SetConfig("observation_changes", true),
                  "tensor \"observation.change_std\": expected, but missing"},
                 {SetConfig("observation_changes", 1),
                  "config.observation_changes: expected true or false, received 1"},
                 {[](auto& c) { c.tensors["observation.change_std"] = Tensor::Zeros({4}); },
                  "tensor \"observation.change_std\": not expected in a policy of mode full in "
                  "float32"}});
  ModelConfig config = SmallConfig();
  config.observation_changes = true;
  ExpectRefused(
      {{[](auto& c) { Numbers(c, "observation.change_std")[1] = 0.0f; },
        "tensor \"observation.change_std\" at index 1: expected a positive finite number, "
        "received 0"},
       {[](auto& c) { c.tensors["observation.change_std"] = Tensor::Zeros({3}); },
        "tensor \"observation.change_std\": expected shape [4], received [3] with 3 values"},
       {SetConfig("observation_changes", false),
        "tensor \"observation.change_std\": not expected in a policy of mode full in float32"}},
      SmallPolicy(config));
}

TEST_F(PolicyFileRefusalTest, Norms) {
  ExpectRefused(
      {{SetConfig("norm", "batch"), "config.norm: expected layer or none, received \"batch\""},
       {SetConfig("norm", "none"),
        "tensor \"embed.action.norm.bias\": not expected in a policy of mode full in "
        "float32 without norms"}});
  ModelConfig config = SmallConfig();
  config.norm = NormKind::kNone;
  ExpectRefused(
      {{SetConfig("norm", "layer"), "tensor \"embed.return.norm.weight\": expected, but missing"}},
      SmallPolicy(config));
}

TEST_F(PolicyFileRefusalTest, TensorsOfAnotherDtype) {
  ExpectRefused({
      {[](auto& c) { c.tensors["head.bias"] = Int8Tensor::Zeros({2}); },
       "tensor \"head.bias\": expected dtype \"F32\", received \"I8\""},
      {[](auto& c) { c.tensors["observation.mean"] = Int16Tensor::Zeros({4}); },
       "tensor \"observation.mean\": expected dtype \"F32\", received \"I16\""},
      {[](auto& c) {
         c.tensors["layers.0.ffn.hidden.weight"] = Int8Tensor::Zeros({32, 16});
       },
       "tensor \"layers.0.ffn.hidden.weight\": expected dtype \"F32\", received \"I8\""},
      {[](auto& c) { c.tensors["layers.0.ffn.hidden.scale"] = Tensor::Zeros({32}); },
       "tensor \"layers.0.ffn.hidden.scale\": not expected in a policy of mode full in float32"},
  });
}

TEST_F(PolicyFileRefusalTest, IntegerTensors) {
  // The largest sum that is allowed, in neuron 2 of 16 coder and 2 phase inputs.
  const auto fill_neuron = [=](Safetensors& c, int bias) {
    for (int j = 0; j < 18; ++j) {
      Numbers<Int8Tensor>(c, "layers.1.attention.key.weight")[2 * 18 + j] = j % 2 == 0 ? 127 : -127;
    }
    Numbers<Int16Tensor>(c, "layers.1.attention.key.bias")[2] = static_cast<int16_t>(bias);
  };
  const std::string too_large =
      "tensor \"layers.1.attention.key.weight\": expected |bias| + sum of |weight| of at most "
      "32767, received 32768 at index 2";
  std::vector<Refusal> refusals = {
      {[](auto& c) { c.tensors.erase("layers.0.attention.value.scale"); },
       "tensor \"layers.0.attention.value.scale\": expected, but missing"},
      {[](auto& c) { c.tensors.erase("layers.1.ffn.hidden.threshold"); },
       "tensor \"layers.1.ffn.hidden.threshold\": expected, but missing"},
      {[](auto& c) { c.tensors["layers.0.ffn.output.threshold"] = Int16Tensor::Zeros({16}); },
       "tensor \"layers.0.ffn.output.threshold\": not expected in a policy of mode full in "
       "integer"},
      {[](auto& c) { c.tensors["layers.0.ffn.hidden.threshold"] = Int16Tensor::Zeros({31}); },
       "tensor \"layers.0.ffn.hidden.threshold\": expected shape [32], received [31] with 31 "
       "values"},
      {[=](auto& c) { Numbers<Int8Tensor>(c, "layers.0.attention.query.weight")[5] = -128; },
       "tensor \"layers.0.attention.query.weight\": expected -127 to 127, received -128 at index "
       "5"},
      {[=](auto& c) { Numbers<Int8Tensor>(c, "layers.1.ffn.output.weight")[0] = -128; },
       "tensor \"layers.1.ffn.output.weight\": expected -127 to 127, received -128 at index 0"},
      {[=](auto& c) { Numbers<Int16Tensor>(c, "layers.0.attention.key.threshold")[3] = 0; },
       "tensor \"layers.0.attention.key.threshold\": expected 1 to 32767, received 0 at index 3"},
      {[=](auto& c) { Numbers<Int16Tensor>(c, "layers.0.ffn.hidden.threshold")[31] = -5; },
       "tensor \"layers.0.ffn.hidden.threshold\": expected 1 to 32767, received -5 at index 31"},
      {[=](auto& c) { fill_neuron(c, 32767 - 18 * 127 + 1); }, too_large},
      {[=](auto& c) { fill_neuron(c, -(32767 - 18 * 127 + 1)); }, too_large},
      {[=](auto& c) {
         for (int j = 0; j < 18; ++j)
           Numbers<Int8Tensor>(c, "layers.1.attention.key.weight")[2 * 18 + j] = 0;
         Numbers<Int16Tensor>(c, "layers.1.attention.key.bias")[2] = -32768;
       },
       too_large},
  };
  for (const char* name : {"layers.1.attention.query.scale", "layers.0.ffn.hidden.scale"}) {
    const std::string tensor = "tensor \"" + std::string(name) + "\": expected ";
    refusals.push_back({[=](auto& c) { Numbers(c, name)[1] = 0.0f; },
                        tensor + "positive finite numbers, received 0 at index 1"});
    refusals.push_back({[=](auto& c) { Numbers(c, name)[1] = -0.5f; },
                        tensor + "positive finite numbers, received -0.5 at index 1"});
    refusals.push_back({[=](auto& c) { Numbers(c, name)[1] = kNan; },
                        tensor + "finite numbers, received nan at index 1"});
  }
  for (const char* name : {"layers.0.attention.query", "layers.0.attention.key",
                           "layers.0.attention.value", "layers.0.ffn.hidden"}) {
    const std::string population = name;
    for (const auto& [part, dtype] : {std::pair("weight", "I8"), std::pair("scale", "F32"),
                                      std::pair("bias", "I16"), std::pair("threshold", "I16")}) {
      const std::string tensor = population + "." + part;
      const bool is_float = std::string(dtype) == "F32";
      refusals.push_back({[=](auto& c) {
                            if (is_float) {
                              c.tensors[tensor] = Int8Tensor::Zeros({16});
                            } else {
                              c.tensors[tensor] = Tensor::Zeros({16});
                            }
                          },
                          "tensor \"" + tensor + "\": expected dtype \"" + dtype +
                              "\", received \"" + (is_float ? "I8" : "F32") + "\""});
    }
  }
  const Policy policy = *QuantizeToInteger(SmallPolicy());
  ExpectRefused(refusals, policy);

  Safetensors contents = *ReadSafetensors(Path("good"));
  fill_neuron(contents, 32767 - 18 * 127);
  ASSERT_TRUE(WriteSafetensors(contents, Path()).ok());
  EXPECT_TRUE(ReadPolicyFile(Path()).ok()) << ReadPolicyFile(Path()).status();
}

TEST_F(PolicyFileRefusalTest, Arithmetics) {
  ExpectRefused({{SetConfig("arithmetic", "int4"),
                  "config.arithmetic: expected float32 or integer, received \"int4\""},
                 {SetConfig("arithmetic", "int8"),
                  "config.arithmetic: expected float32 or integer, received int8, which is no "
                  "longer served: `spiketrain quantize --policy=OLD --out=NEW` converts the file "
                  "to integers, and with --to=float32 to float32"}});
}

TEST_F(PolicyFileRefusalTest, ADenseTimestepEmbeddingOfNoRows) {
  ASSERT_TRUE(WritePolicyFile(SmallPolicy(SmallConfig(Mode::kDense)), Path()).ok());
  Safetensors contents = *ReadSafetensors(Path());
  contents.tensors["embed.timestep.weight"] = Tensor::Zeros({0, 16});
  ASSERT_TRUE(WriteSafetensors(contents, Path()).ok());
  EXPECT_EQ(ReadPolicyFile(Path()).status().message(),
            Path() +
                ": tensor \"embed.timestep.weight\": expected shape [any, 16], received [0, 16] "
                "with 0 values");
}

TEST_F(PolicyFileRefusalTest, Metadata) {
  std::vector<Refusal> refusals;
  const auto set = [&](const char* key, const std::string& value, const std::string& message) {
    refusals.push_back({[=](Safetensors& c) { c.metadata[key] = value; }, message});
  };
  for (const char* key :
       {"format", "config", "action_space", "return_offset", "return_scale", "target_return",
        "modulator_mean", "modulator_std", "environment", "training"}) {
    refusals.push_back({[key](Safetensors& c) { c.metadata.erase(key); },
                        "__metadata__: expected key \"" + std::string(key) + "\", received none"});
  }
  refusals.push_back({[](Safetensors& c) { c.metadata.clear(); },
                      "__metadata__: expected key \"format\", received none"});
  set("format", "pt", "format: expected \"spikeserve.policy.v1\", received \"pt\"");
  for (const char* text :
       {"", " 1", "1 ", "1x", "+1", "0x1", "one", "nan", "inf", "-inf", "1e39"}) {
    set("return_offset", text,
        "return_offset: expected a finite number that fits float32, received \"" +
            std::string(text) + "\"");
  }
  set("environment", "x\x1b]52",
      "environment: expected printable characters, received \"x\\x1b]52\"");
  set("return_scale", "0", "return_scale: expected a positive finite number, received 0");
  set("return_scale", "-250", "return_scale: expected a positive finite number, received -250");
  set("target_return", "nan",
      "target_return: expected a finite number that fits float32, received \"nan\"");
  set("modulator_mean", "inf",
      "modulator_mean: expected a finite number that fits float32, received \"inf\"");
  set("modulator_std", "0", "modulator_std: expected a positive finite number, received 0");
  set("training", "[1, 2]", "training: expected a JSON object, received an array of 2");
  ExpectRefused(refusals);
}

TEST_F(PolicyFileRefusalTest, ActionSpace) {
  std::vector<Refusal> refusals;
  const auto set = [&](const std::string& value, const std::string& message) {
    refusals.push_back({[=](Safetensors& c) { c.metadata["action_space"] = value; }, message});
  };
  set("Discrete(2)", "action_space: expected valid JSON in UTF-8, received an error at byte 1");
  set("2", "action_space: expected a JSON object, received 2");
  set("{}", "action_space.type: expected \"Discrete\" or \"Box\", received none");
  set(R"({"type": "MultiBinary", "n": 2})",
      "action_space.type: expected \"Discrete\" or \"Box\", received \"MultiBinary\"");
  set(R"({"type": "Discrete"})", "action_space: expected key \"n\", received none");
  set(R"({"type": "Discrete", "n": 4294967298})",
      "action_space.n: expected an integer from 0 to 2147483647, received 4294967298");
  set(R"({"type": "Discrete", "n": 0})", "action_space.n: expected at least 1, received 0");
  set(R"({"type": "Discrete", "n": 2, "start": 1})",
      "action_space: expected no other keys, received \"start\"");
  set(R"({"type": "Discrete", "n": 2147483647})",
      "tensor \"embed.action.weight\": expected shape [16, 2147483647], received [16, 2] with 32 "
      "values");
  set(R"({"type": "Box", "low": [-1]})", "action_space: expected key \"high\", received none");
  set(R"({"type": "Box", "low": -1, "high": [1]})",
      "action_space.low: expected an array, received -1");
  set(R"({"type": "Box", "low": [-1, "x"], "high": [1, 1]})",
      "action_space.low[1]: expected a number that fits float32, received \"x\"");
  set(R"({"type": "Box", "low": [-1e39], "high": [1]})",
      "action_space.low[0]: expected a number that fits float32, received -1e+39");
  set(R"({"type": "Box", "low": [-1], "high": [1, 1]})",
      "action_space: expected low and high of one length, received 1 and 2");
  set(R"({"type": "Box", "low": [1], "high": [-1]})",
      "action_space: expected finite bounds with low[0] < high[0], received 1 and -1");
  set(R"({"type": "Box", "low": [], "high": []})",
      "action_space.n: expected at least 1, received 0");
  ExpectRefused(refusals);
}

TEST_F(PolicyFileRefusalTest, Config) {
  std::vector<Refusal> refusals;
  const auto set = [&](const char* key, const json& value, const std::string& message) {
    refusals.push_back({SetConfig(key, value), message});
  };
  for (const char* key :
       {"mode", "hidden_size", "heads", "layers", "ticks", "context", "routing_hidden_size",
        "ffn_size", "membrane_decay", "threshold", "coder", "phase_clock", "merge", "gate"}) {
    refusals.push_back({[key](Safetensors& c) {
                          json config = json::parse(c.metadata["config"]);
                          config.erase(key);
                          c.metadata["config"] = config.dump();
                        },
                        "config: expected key \"" + std::string(key) + "\", received none"});
  }
  refusals.push_back({[](Safetensors& c) { c.metadata["config"] = "[]"; },
                      "config: expected a JSON object, received an array of 0"});
  set("dropout", 0.1, "config: expected no other keys, received \"dropout\"");
  set("mode", "half",
      "config.mode: expected baseline, pos, route, full or dense, "
      "received "
      "\"half\"");
  set("coder", "poisson", "config.coder: expected lif, received \"poisson\"");
  set("phase_clock", "tick", "config.phase_clock: expected timestep or window, received \"tick\"");
  set("merge", "mean", "config.merge: expected sum or concat, received \"mean\"");
  set("gate", "relu", "config.gate: expected softmax or sigmoid, received \"relu\"");
  set("gate", 1, "config.gate: expected a string, received 1");
  set("hidden_size", "8",
      "config.hidden_size: expected an integer from 0 to 2147483647, received \"8\"");
  set("layers", 1000000000, "layers: expected 1 to 64, received 1000000000");
  set("hidden_size", 1 << 20, "hidden_size: expected 1 to 4096, received 1048576");
  set("hidden_size", 9, "hidden_size: expected a multiple of heads = 2, received 9");
  set("ticks", 0, "ticks: expected 1 to 256, received 0");
  set("context", 100000, "context: expected 1 to 4096, received 100000");
  set("heads", 128, "heads: expected 1 to 64, received 128");
  set("routing_hidden_size", 0, "routing_hidden_size: expected 1 to 4096, received 0");
  set("ffn_size", 16385, "ffn_size: expected 1 to 16384, received 16385");
  set("membrane_decay", 1e39,
      "config.membrane_decay: expected a number that fits float32, received 1e+39");
  set("membrane_decay", 2, "membrane_decay: expected 0 to 1, received 2");
  set("threshold", -1.0, "threshold: expected a positive finite number, received -1");
  set("layers", 3, "tensor \"layers.2.coder.gain\": expected, but missing");
  set("mode", "baseline",
      "tensor \"layers.0.routing.gate.bias\": not expected in a policy of "
      "mode baseline in float32");
  ExpectRefused(refusals);
}

TEST_F(PolicyFileRefusalTest, SumsOfIntegersThatCanOverflow) {
  ExpectRefused(
      {{[](auto& c) {
          const std::string map = "layers.0.attention.output";
          for (int j = 0; j < 8; ++j) Numbers<Int8Tensor>(c, map + ".weight")[8 + j] = 127;
          Numbers<Int8Tensor>(c, map + ".shift")[1] = -15;
          Numbers<Int16Tensor>(c, map + ".bias")[1] = 0;
        },
        "tensor \"layers.0.attention.output.weight\": expected sums of at most 2147450880 for "
        "inputs of at most 255, received 8489533440 at index 1"},
       {[](auto& c) {
          const std::string hidden = "layers.1.ffn.hidden";
          for (int j = 0; j < 16; ++j) Numbers<Int8Tensor>(c, hidden + ".weight")[32 + j] = 127;
          Numbers<Int16Tensor>(c, hidden + ".bias")[2] = -30736;
        },
        "tensor \"layers.1.ffn.hidden.weight\": expected |bias| + sum of |weight| of at most "
        "32767, received 32768 at index 2"}},
      *QuantizeToInteger(SmallPolicy()));
}

TEST_F(PolicyFileRefusalTest, IntegersOutOfRange) {
  ExpectRefused(
      {{[](auto& c) { Numbers<Int8Tensor>(c, "readout.coder.sign")[3] = 0; },
        "tensor \"readout.coder.sign\": expected 1 or -1, received 0 at index 3"},
       {[](auto& c) {
          auto& thresholds = Numbers<Int16Tensor>(c, "layers.0.coder.threshold");
          thresholds[5] = 7;
          thresholds[6] = 8;
        },
        "tensor \"layers.0.coder.threshold\": expected at most 7, received 8 at index 6"},
       {[](auto& c) { Numbers<Int8Tensor>(c, "embed.state.norm.shift")[0] = 16; },
        "tensor \"embed.state.norm.shift\": expected 0 to 15, received 16 at index 0"},
       {[](auto& c) { Numbers<Int8Tensor>(c, "layers.0.ffn.output.shift")[2] = 32; },
        "tensor \"layers.0.ffn.output.shift\": expected -15 to 31, received 32 at index 2"}},
      *QuantizeToInteger(SmallPolicy()));
}

TEST_F(PolicyFileRefusalTest, ConfigsThatIntegersLack) {
  ExpectRefused(
      {{SetConfig("coder", "bernoulli"), "config.coder: expected lif, received \"bernoulli\""},
       {SetConfig("membrane_decay", 0.95),
        "membrane_decay: expected 1 - m / 256 for an m from 1 to 128 in integers, received 0.95"},
       {SetConfig("leak", "none"), "config.leak: expected shift, received \"none\""},
       {SetConfig("attention", "linear"),
        "config.attention: expected shiftmax_by_tick or shiftmax, received \"linear\""},
       {[](auto& c) {
          for (const auto& [key, value] :
               {std::pair("attention", "shiftmax"), {"merge", "concat"}, {"gate", "sigmoid"}}) {
            SetConfig(key, value)(c);
          }
        },
        "attention: expected shiftmax_by_tick with concatenated heads and sigmoid gates, "
        "received shiftmax, which multiplied these gates by the heads; quantize the float32 "
        "policy again"},
       {SetConfig("ticks", 256), "ticks: expected 1 to 255, received 256"},
       {SetConfig("input_fraction", 15), "input_fraction: expected 1 to 14, received 15"}},
      *QuantizeToInteger(SmallPolicy()));
}

}  // namespace
}  // namespace spikeserve
