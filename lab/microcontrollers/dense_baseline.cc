// Writes C tables of the dense int8 transformer that has the sizes of a shipped policy, and random
// weights, which do not change its cost.
//
// usage: dense_baseline POLICY_FILE DECISIONS OUT_DIR
//
// Writes OUT_DIR/dense_tables.h, which dense.c includes, and OUT_DIR/stream with the inputs of
// DECISIONS decisions of one episode: the action before (not at the first), the return-to-go and
// the observation, in float32. Prints the hash of the logits of the server's engine, and the mean
// picojoules of a decision by int_45nm and int_sram_45nm.
#include <bit>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <memory>
#include <numbers>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/emit/policy_tables.h"
#include "core/engine/account.h"
#include "core/engine/energy.h"
#include "core/engine/factory/engine_factory.h"
#include "core/math/counter_random.h"
#include "core/math/exp.h"
#include "core/model/policy_file.h"
#include "core/quantize/quantize_integer.h"

namespace spikeserve {
namespace {

template <class T>
T ValueOf(absl::StatusOr<T> value) {
  if (value.ok()) return *std::move(value);
  std::cerr << value.status() << "\n";
  std::exit(1);
}

Policy TwinOf(const Policy& policy) {
  ModelConfig config = DenseBaseline(policy.config);
  config.arithmetic = Arithmetic::kFloat32;
  // An attention's sum has 255 times 127 times 2^8 for each key, and is doubled to be divided.
  if (int64_t{2} * 255 * 127 * 256 * 3 * config.context > INT32_MAX) {
    std::cerr << "policy: expected a context whose sums have 32 bits, received " << config.context
              << "\n";
    std::exit(1);
  }
  Policy twin = RandomPolicy(config, policy.observation_size(), policy.action_space, /*seed=*/1);
  // One row of the embedding of timesteps is enough to add it.
  twin.weights.embed_timestep.shape[0] = 1;
  twin.weights.embed_timestep.values.resize(static_cast<size_t>(config.hidden_size));
  return ValueOf(QuantizeToInteger(twin));
}

class Tables {
 public:
  explicit Tables(const Policy& policy) : policy_(policy), config_(policy.config) {}

  std::string Run(uint64_t decisions) {
    const FixedPointEnds& ends = policy_.weights.fixed_point;
    Sizes(decisions);
    Gelu();
    Array("int16_t", "timestep_embedding", ends.embed_timestep.values);
    Embedding("embed_return", ends.embed_return);
    Embedding("embed_state", ends.embed_state);
    Embedding("embed_action", ends.embed_action);
    std::string layers;
    for (size_t i = 0; i < policy_.weights.layers.size(); ++i) {
      const FixedPointLayer& w = policy_.weights.layers[i].fixed_point;
      const std::string name = absl::StrCat("layer", i, "_");
      absl::StrAppend(&layers, "{", Map(name + "query", w.query), ", ", Map(name + "key", w.key),
                      ", ", Map(name + "value", w.value), ", ",
                      Map(name + "attention_output", w.attention_output), ", ",
                      Map(name + "ffn_hidden", w.ffn_hidden), ", ",
                      Map(name + "ffn_output", w.ffn_output), ", ");
      absl::StrAppend(&layers, Norm(name + "attention_norm", w.attention_norm), ", ",
                      Norm(name + "ffn_norm", w.ffn_norm), "},\n");
    }
    absl::StrAppend(&text_, "static const dense_layer layers[] = {\n", layers, "};\n");
    Array("float", "head_weight", policy_.weights.head.weight.values);
    Array("float", "head_bias", policy_.weights.head.bias.values);
    return text_;
  }

 private:
  void Define(absl::string_view name, int64_t value) {
    absl::StrAppend(&text_, "#define DENSE_", name, " ", value, "\n");
  }

  void Sizes(uint64_t decisions) {
    Define("DECISIONS", static_cast<int64_t>(decisions));
    Define("OBSERVATIONS", policy_.observation_size());
    Define("CHANGES", int{config_.observation_changes});
    Define("ACTIONS", policy_.action_space.size());
    Define("HIDDEN", config_.hidden_size);
    Define("HEADS", config_.heads);
    Define("HEAD_SIZE", config_.head_size());
    Define("CONTEXT", config_.context);
    Define("LAYERS", config_.layers);
    Define("FFN", config_.ffn_size);
    Define("FRACTION", config_.residual_fraction);
    Define("INPUT_UNIT", int64_t{1} << config_.input_fraction);
    const double scale = std::numbers::log2e / std::sqrt(static_cast<double>(config_.head_size()));
    Define("SCALE", std::lround(1024.0 * scale));
  }

  // x minus the activation of x, in steps of 1/32 (core/engine/dense/integer_dense_pass.cc).
  void Gelu() {
    std::vector<int> table;
    for (int i = 0; i < 128; ++i) {
      const float x = static_cast<float>(i) / 32.0f;
      const float gelu =
          0.5f * x * (1.0f + Tanh(0.7978845608028654f * (x + 0.044715f * x * x * x)));
      table.push_back(
          static_cast<int>(std::nearbyint(std::ldexp(x - gelu, config_.residual_fraction))));
    }
    Array("int16_t", "gelu", table);
  }

  template <class Numbers>
  std::string Array(absl::string_view type, const std::string& name, const Numbers& numbers) {
    absl::StrAppend(&text_, CTable(type, name, numbers));
    return name;
  }

  std::string Map(const std::string& name, const FixedPointMap& map) {
    return absl::StrCat("{", Array("int8_t", name + "_weight", map.weight.values), ", ",
                        Array("int8_t", name + "_shift", map.shift.values), ", ",
                        Array("int16_t", name + "_bias", map.bias.values), ", ",
                        map.weight.shape[1], ", ", map.weight.shape[0], "}");
  }

  std::string Norm(const std::string& name, const FixedPointNorm& norm) {
    return absl::StrCat("{", Array("int16_t", name + "_weight", norm.weight.values), ", ",
                        Array("int16_t", name + "_bias", norm.bias.values), ", ",
                        int{norm.shift.values[0]}, "}");
  }

  void Embedding(const std::string& name, const FixedPointEmbedding& embedding) {
    const std::string members = absl::StrCat(Map(name + "_map", embedding.linear), ", ",
                                             Norm(name + "_norm", embedding.norm));
    absl::StrAppend(&text_, "static const dense_embedding ", name, " = {", members, "};\n");
  }

  const Policy& policy_;
  const ModelConfig& config_;
  std::string text_;
};

// Decides, and writes what is decided on.
class Player {
 public:
  Player(std::shared_ptr<const Policy> policy, const std::string& path)
      : policy_(policy),
        engine_(MakeEngine(policy)),
        context_(engine_->NewContext()),
        stream_(path, std::ios::binary) {}

  void Decide(uint64_t decision) {
    const int actions = policy_->action_space.size();
    if (decision > 0) {
      const std::vector<float> action = Numbers(decision, 1, actions, 2.0f);
      engine_->AppendAction(*context_, action);
    }
    const std::vector<float> target = Numbers(decision, 2, 1, 2.0f);
    const std::vector<float> observation = Numbers(decision, 3, policy_->observation_size(), 4.0f);
    Engine::Output output;
    engine_->Decide(*context_, target[0], observation, &output);
    const Linear& head = policy_->weights.head;
    for (int i = 0; i < actions; ++i) {
      float z = head.bias.values[static_cast<size_t>(i)];
      for (size_t j = 0; j < output.readout.size(); ++j)
        z += head.weight.values[static_cast<size_t>(i) * output.readout.size() + j] *
             output.readout[j];
      AddToHash(std::bit_cast<uint32_t>(z));
    }
    operations_ += *EstimateEnergy(EnergyModel::kInt45nm, output.counts, policy_->config);
    with_memory_ += *EstimateEnergy(EnergyModel::kIntSram45nm, output.counts, policy_->config);
  }

  void Print(uint64_t decisions) const {
    const double picojoules = 1e12 / static_cast<double>(decisions);
    std::cout << std::hex << hash_ << " " << std::dec << std::llround(picojoules * operations_)
              << " " << std::llround(picojoules * with_memory_) << "\n";
  }

 private:
  // Returns numbers around 0, and writes them.
  std::vector<float> Numbers(uint64_t decision, uint64_t kind, int size, float spread) {
    std::vector<float> numbers;
    for (int i = 0; i < size; ++i) {
      const uint64_t bits = RandomBits({kind, decision, static_cast<uint64_t>(i)});
      numbers.push_back(spread * (UniformFloat(bits) - 0.5f));
      stream_.write(reinterpret_cast<const char*>(&numbers.back()), 4);
    }
    return numbers;
  }

  // FNV-1a, least significant byte first.
  void AddToHash(uint32_t value) {
    for (int i = 0; i < 4; ++i) hash_ = (hash_ ^ (value >> (8 * i) & 255)) * 0x100000001b3;
  }

  std::shared_ptr<const Policy> policy_;
  std::unique_ptr<Engine> engine_;
  std::unique_ptr<Engine::Context> context_;
  std::ofstream stream_;
  uint64_t hash_ = 0xcbf29ce484222325;
  double operations_ = 0.0, with_memory_ = 0.0;
};

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  if (argc != 4) {
    std::cerr << "usage: dense_baseline POLICY_FILE DECISIONS OUT_DIR\n";
    return 1;
  }
  const auto twin = std::make_shared<const spikeserve::Policy>(
      spikeserve::TwinOf(spikeserve::ValueOf(spikeserve::ReadPolicyFile(argv[1]))));
  const uint64_t decisions = std::stoull(argv[2]);
  const std::string folder = argv[3];
  std::ofstream(folder + "/dense_tables.h") << spikeserve::Tables(*twin).Run(decisions);
  spikeserve::Player player(twin, folder + "/stream");
  for (uint64_t i = 0; i < decisions; ++i) player.Decide(i);
  player.Print(decisions);
}
