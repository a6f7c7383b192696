#include "core/emit/policy_tables.h"

#include <cstdint>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "core/engine/account.h"
#include "core/neuron/phase.h"

namespace spikeserve {
namespace {

// Writes tables, each before the struct that points to it.
class TableWriter {
 public:
  explicit TableWriter(const Policy& policy) : policy_(policy), config_(policy.config) {}

  PolicyTables Run() {
    const Weights& weights = policy_.weights;
    const FixedPointEnds& ends = weights.fixed_point;
    Embedding("embed_return", ends.embed_return);
    Embedding("embed_state", ends.embed_state);
    Embedding("embed_action", ends.embed_action);
    std::string layers;
    for (size_t i = 0; i < weights.layers.size(); ++i) {
      absl::StrAppend(&layers, layers.empty() ? "" : ",\n",
                      Layer(absl::StrCat("layer", i, "_"), weights.layers[i]));
    }
    absl::StrAppend(&text_, "static const spike_layer layers[SPIKE_LAYERS] = {\n", layers, "};\n");
    absl::StrAppend(&text_, "static const spike_coder readout_coder = ",
                    Coder("readout_coder_", ends.readout_coder), ";\n");
    Phases();
    Head();
    Prices();
    return {text_, bytes_};
  }

 private:
  // Writes numbers, as those of `Stored`, and returns the name of their table.
  template <class Stored, class Numbers>
  std::string Table(absl::string_view type, const std::string& name, const Numbers& numbers) {
    absl::StrAppend(&text_, CTable(type, name, numbers));
    bytes_ += static_cast<int64_t>(sizeof(Stored) * numbers.size());
    return name;
  }

  // Writes the columns of `weight` [out, in] one after the other, and the nonzero numbers of each.
  std::string Columns(const std::string& name, const Int8Tensor& weight) {
    std::vector<int8_t> columns;
    std::vector<int> nonzero;
    for (int j = 0; j < weight.shape[1]; ++j) {
      nonzero.push_back(0);
      for (int k = 0; k < weight.shape[0]; ++k) {
        columns.push_back(weight.at(k, j));
        nonzero.back() += weight.at(k, j) != 0;
      }
    }
    return absl::StrCat(Table<int8_t>("int8_t", name + "weight", columns), ", ",
                        Table<uint16_t>("uint16_t", name + "nonzero", nonzero));
  }

  std::string Map(const std::string& name, const FixedPointMap& map) {
    return absl::StrCat("{", Columns(name, map.weight), ", ",
                        Table<int8_t>("int8_t", name + "shift", map.shift.values), ", ",
                        Table<int16_t>("int16_t", name + "bias", map.bias.values), ", ",
                        map.weight.shape[1], ", ", map.weight.shape[0], "}");
  }

  std::string Norm(const std::string& name, const FixedPointNorm& norm) {
    if (!config_.has_norms()) return "{NULL, NULL, 0}";
    return absl::StrCat("{", Table<int16_t>("int16_t", name + "weight", norm.weight.values), ", ",
                        Table<int16_t>("int16_t", name + "bias", norm.bias.values), ", ",
                        int{norm.shift.values[0]}, "}");
  }

  std::string Mapped(const std::string& name, const FixedPointMap& map,
                     const FixedPointNorm& norm) {
    return absl::StrCat("{", Map(name, map), ", ", Norm(name + "norm_", norm), "}");
  }

  std::string Coder(const std::string& name, const PeriodCoder& coder) {
    return absl::StrCat("{", Table<int8_t>("int8_t", name + "sign", coder.sign.values), ", ",
                        Table<int16_t>("int16_t", name + "threshold", coder.threshold.values), "}");
  }

  std::string Population(const std::string& name, const IntegerPopulation& population) {
    return absl::StrCat("{", Columns(name, population.weight), ", ",
                        Table<int16_t>("int16_t", name + "bias", population.bias.values), ", ",
                        Table<int16_t>("int16_t", name + "threshold", population.threshold.values),
                        ", ", population.weight.shape[0], "}");
  }

  void Embedding(const std::string& name, const FixedPointEmbedding& embedding) {
    const std::string value = Mapped(name + "_", embedding.linear, embedding.norm);
    absl::StrAppend(&text_, "static const spike_mapped ", name, " = ", value, ";\n");
  }

  std::string Layer(const std::string& name, const LayerWeights& layer) {
    const FixedPointLayer& maps = layer.fixed_point;
    std::vector<std::string> members = {
        Coder(name + "coder_", maps.coder),
        Coder(name + "ffn_coder_", maps.ffn_coder),
        Population(name + "query_", layer.integer.query),
        Population(name + "key_", layer.integer.key),
        Population(name + "value_", layer.integer.value),
        Population(name + "ffn_hidden_", layer.integer.ffn_hidden),
        Mapped(name + "attention_output_", maps.attention_output, maps.attention_norm),
        Mapped(name + "ffn_output_", maps.ffn_output, maps.ffn_norm),
        Table<int16_t>("int16_t", name + "attention_scale", maps.attention_scale.values)};
    if (config_.has_routing()) {
      members.push_back(Map(name + "routing_hidden_", maps.routing_hidden));
      members.push_back(Map(name + "routing_gate_", maps.routing_gate));
    }
    return absl::StrCat("    {", absl::StrJoin(members, ",\n     "), "}");
  }

  void Phases() {
    if (!config_.has_phase()) return;
    absl::StrAppend(&text_, "/* start, step, step of a tick: in units of 2^-32 turns */\n",
                    "static const uint32_t phases[SPIKE_HEADS][3] = {\n");
    for (int k = 0; k < config_.heads; ++k) {
      const IntegerPhase phase = MakeIntegerPhase(
          policy_.weights.phase_omega.values[k], policy_.weights.phase_phi.values[k], config_.ticks,
          config_.phase_clock == PhaseClock::kWindow);
      absl::StrAppend(&text_, "    {", phase.start, "u, ", phase.step, "u, ", phase.step_per_tick,
                      "u},\n");
    }
    text_ += "};\n";
  }

  void Head() {
    const Weights& weights = policy_.weights;
    Table<float>("float", "observation_mean", weights.observation_mean.values);
    Table<float>("float", "observation_std", weights.observation_std.values);
    if (config_.observation_changes)
      Table<float>("float", "change_std", weights.observation_change_std.values);
    if (!policy_.action_space.is_discrete()) {
      Table<float>("float", "action_low", policy_.action_space.low);
      Table<float>("float", "action_high", policy_.action_space.high);
    }
    Table<float>("float", "head_weight", weights.head.weight.values);
    Table<float>("float", "head_bias", weights.head.bias.values);
    std::vector<int> nonzero(config_.hidden_size, 0);
    for (size_t i = 0; i < weights.head.weight.values.size(); ++i) {
      nonzero[i % nonzero.size()] += weights.head.weight.values[i] != 0.0f;
    }
    Table<uint16_t>("uint16_t", "head_nonzero", nonzero);
  }

  void Prices() {
    std::vector<double> operations;
    for (const PricedOperation& operation : OperationsOf(Counts(), config_))
      operations.push_back(operation.price);
    std::vector<double> bytes;
    for (const PricedTraffic& traffic : TrafficOf(Counts(), config_))
      bytes.push_back(traffic.price);
    text_ += "/* in picojoules (core/engine/account.cc) */\n";
    Table<double>("double", "operation_price", operations);
    Table<double>("double", "byte_price", bytes);
  }

  const Policy& policy_;
  const ModelConfig& config_;
  std::string text_;
  int64_t bytes_ = 0;
};

constexpr size_t kWidth = 100;

// Returns the number with a point or an exponent, without which it would be an integer.
std::string Pointed(std::string number) {
  if (number.find_first_of(".e") == std::string::npos) number += ".0";
  return number;
}

}  // namespace

PolicyTables TablesOf(const Policy& policy) { return TableWriter(policy).Run(); }

std::string CNumber(float number) { return Pointed(absl::StrFormat("%.9g", number)) + "f"; }
std::string CNumber(double number) { return Pointed(absl::StrFormat("%.17g", number)); }

std::string CArray(absl::string_view type, absl::string_view name,
                   absl::Span<const std::string> numbers) {
  std::string text =
      absl::StrCat("static const ", type, " ", name, "[", numbers.size(), "] = {\n    ");
  size_t column = 4;
  for (size_t i = 0; i < numbers.size(); ++i) {
    const bool is_last = i + 1 == numbers.size();
    if (column + numbers[i].size() + 1 > kWidth) {
      text += "\n    ";
      column = 4;
    }
    absl::StrAppend(&text, numbers[i], is_last ? "" : ",");
    column += numbers[i].size() + 1;
    if (is_last || column >= kWidth) continue;
    text += ' ';
    ++column;
  }
  return text + "};\n";
}

}  // namespace spikeserve
