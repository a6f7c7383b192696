#include "core/quantize/int8_file.h"

#include <algorithm>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/policy_file.h"
#include "core/model/safetensors.h"

namespace spikeserve {
namespace {

// A membrane is a whole number of units, so it reaches its threshold where it exceeds a quarter of
// a unit less. No rounding of float32 crosses that, and rounding to units gives the threshold back.
constexpr float kMargin = 0.25f;

// Takes the tensor `name` with one number for each of `outputs` neurons away.
template <class Number>
absl::StatusOr<std::vector<Number>> TakeVector(const std::string& name, int outputs,
                                               Safetensors* contents) {
  const auto node = contents->tensors.extract(name);
  const auto* const tensor =
      node.empty() ? nullptr : std::get_if<BasicTensor<Number>>(&node.mapped());
  if (tensor != nullptr && tensor->shape == std::vector<int>{outputs}) return tensor->values;
  return InvalidArgument(absl::StrCat("tensor ", Quoted(name)),
                         absl::StrCat(outputs, " numbers of dtype ",
                                      DtypeName(BasicTensor<Number>()), " in a policy in int8"),
                         "others");
}

// Returns what a unit of each neuron of the map `name` stands for in float32.
absl::StatusOr<std::vector<float>> TakeUnits(const std::string& name, int outputs, float threshold,
                                             Safetensors* contents) {
  ASSIGN_OR_RETURN(std::vector<float> units, TakeVector<float>(name + ".scale", outputs, contents));
  if (!contents->tensors.contains(name + ".threshold")) return units;
  ASSIGN_OR_RETURN(const std::vector<int16_t> levels,
                   TakeVector<int16_t>(name + ".threshold", outputs, contents));
  for (size_t k = 0; k < units.size(); ++k) {
    units[k] = threshold / (static_cast<float>(std::max<int16_t>(levels[k], 1)) - kMargin);
  }
  return units;
}

// Replaces the map `name` by one in float32.
absl::Status RestoreMap(const std::string& name, float threshold, Safetensors* contents) {
  const auto levels = std::get<Int8Tensor>(contents->tensors.at(name + ".weight"));
  if (levels.shape.size() != 2) {
    return InvalidArgument(absl::StrCat("tensor ", Quoted(name + ".weight")), "a matrix",
                           absl::StrCat(levels.shape.size(), " dimensions"));
  }
  const int outputs = levels.shape[0];
  const bool is_population = contents->tensors.contains(name + ".threshold");
  ASSIGN_OR_RETURN(const std::vector<float> units, TakeUnits(name, outputs, threshold, contents));
  Linear map = {Tensor::Zeros(levels.shape), Tensor::Zeros({outputs})};
  const auto inputs = static_cast<size_t>(levels.shape[1]);
  for (size_t i = 0; i < levels.values.size(); ++i) {
    map.weight.values[i] = static_cast<float>(levels.values[i]) * units[i / inputs];
  }
  contents->tensors[name + ".weight"] = std::move(map.weight);
  if (!is_population) return absl::OkStatus();  // its bias is in float32
  ASSIGN_OR_RETURN(const std::vector<int16_t> biases,
                   TakeVector<int16_t>(name + ".bias", outputs, contents));
  for (size_t k = 0; k < biases.size(); ++k) {
    map.bias.values[k] = static_cast<float>(biases[k]) * units[k];
  }
  contents->tensors[name + ".bias"] = std::move(map.bias);
  return absl::OkStatus();
}

// Turns a policy in int8 into one in float32. Returns whether it was one; leaves any other as it
// is, for the reader of policies to check.
absl::StatusOr<bool> Restore(Safetensors* contents) {
  const auto text = contents->metadata.find("config");
  if (text == contents->metadata.end()) return false;
  ASSIGN_OR_RETURN(nlohmann::json config, ParseJsonObject("config", text->second));
  if (config.value("arithmetic", nlohmann::json()) != "int8") return false;
  config.erase("arithmetic");
  text->second = config.dump();
  const nlohmann::json threshold = config.value("threshold", nlohmann::json());
  if (!threshold.is_number()) return true;
  std::vector<std::string> maps;
  for (const auto& [name, tensor] : contents->tensors) {
    absl::string_view map = name;
    if (!absl::ConsumeSuffix(&map, ".weight")) continue;
    if (std::holds_alternative<Int8Tensor>(tensor)) maps.emplace_back(map);
  }
  for (const std::string& map : maps) {
    RETURN_IF_ERROR(RestoreMap(map, threshold.get<float>(), contents));
  }
  return true;
}

absl::StatusOr<ConvertiblePolicy> Read(const std::string& path) {
  ASSIGN_OR_RETURN(Safetensors contents, ReadSafetensors(path));
  ASSIGN_OR_RETURN(const bool was_int8, Restore(&contents));
  ASSIGN_OR_RETURN(const std::string bytes, FormatSafetensors(contents));
  ASSIGN_OR_RETURN(Policy policy, ParsePolicyFile(bytes));
  return ConvertiblePolicy{std::move(policy), was_int8};
}

}  // namespace

absl::StatusOr<ConvertiblePolicy> ReadConvertiblePolicy(const std::string& path) {
  absl::StatusOr<ConvertiblePolicy> policy = Read(path);
  if (!policy.ok()) return Annotate(policy.status(), path);
  return policy;
}

}  // namespace spikeserve
