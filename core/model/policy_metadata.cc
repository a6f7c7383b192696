#include "core/model/policy_metadata.h"

#include <array>
#include <charconv>
#include <cmath>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/types/span.h"
#include "core/base/fields.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/wiring_model.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;
using nlohmann::ordered_json;

constexpr char kFormat[] = "spikeserve.policy.v1";

// Keys that had other values in former versions, too; the last one of integer arithmetic alone.
constexpr std::array<std::pair<const char*, const char*>, 2> kFormerChoices = {
    {{"coder", "lif"}, {"leak", "shift"}}};

// Returns the keys of kFormerChoices that a policy has.
absl::Span<const std::pair<const char*, const char*>> FormerChoices(const ModelConfig& config) {
  return absl::MakeConstSpan(kFormerChoices).first(config.is_integer() ? 2 : 1);
}

// The keys of `config`, which the reader and the writer share.
SPIKESERVE_VISITOR(VisitConfig, ModelConfig, mode, hidden_size, heads, layers, ticks, context,
                   routing_hidden_size, ffn_size, membrane_decay, threshold, phase_clock, merge,
                   gate)

// The keys that only policies in integer arithmetic have.
SPIKESERVE_VISITOR(VisitIntegerConfig, ModelConfig, attention, input_fraction, residual_fraction)

// The numbers that have metadata keys of their own, beside `config`.
SPIKESERVE_VISITOR(VisitNumbers, Policy, return_offset, return_scale, target_return, modulator_mean,
                   modulator_std)

// Parses a number that has a metadata key of its own; metadata values are strings.
absl::Status Parse(absl::string_view field, const std::string& text, float* number) {
  const char* const end = text.data() + text.size();
  const auto [rest, error] = std::from_chars(text.data(), end, *number);
  if (error == std::errc() && rest == end && std::isfinite(*number)) return absl::OkStatus();
  return InvalidArgument(field, "a finite number that fits float32", Quoted(text));
}

std::string Format(float number) {
  char text[32];  // the shortest form that parses to the same float32 has at most 15 characters
  const auto result = std::to_chars(text, text + sizeof(text), number);
  return std::string(text, result.ptr);
}

std::string FormatConfig(const ModelConfig& config) {
  ordered_json object;
  const auto write = [&object](const char* key, const auto& value) {
    if constexpr (std::is_enum_v<std::decay_t<decltype(value)>>) {
      object[key] = std::string(ToString(value));
    } else {
      object[key] = value;  // exact: every float32 is a double
    }
  };
  VisitConfig(config, write);
  // Files without these keys have the default, so that versions that do not know the keys can read
  // them.
  if (config.arithmetic != Arithmetic::kFloat32) {
    object["arithmetic"] = std::string(ToString(config.arithmetic));
  }
  for (const auto& [key, name] : FormerChoices(config)) object[key] = name;
  if (config.is_integer()) VisitIntegerConfig(config, write);
  if (config.observation_changes) object["observation_changes"] = true;
  if (!config.has_norms()) object["norm"] = std::string(ToString(config.norm));
  return object.dump();
}

// Returns INVALID_ARGUMENT for the arithmetic of former releases that is no longer served.
absl::Status RefuseInt8(const Json& config) {
  const auto arithmetic = config.find("arithmetic");
  if (arithmetic == config.end() || *arithmetic != "int8") return absl::OkStatus();
  return InvalidArgument(
      "config.arithmetic", "float32 or integer",
      "int8, which is no longer served: `spiketrain quantize --policy=OLD --out=NEW` "
      "converts the file to integers, and with --to=float32 to float32");
}

absl::Status ParseConfig(const std::string& text, ModelConfig* config) {
  ASSIGN_OR_RETURN(const Json object, ParseJsonObject("config", text));
  JsonObject reader("config", object);
  const auto read = [&reader](const char* key, auto& member) {
    // Sizes are never negative; ModelConfig::Validate() checks their other bounds.
    if constexpr (std::is_same_v<decltype(member), int&>) {
      reader.Required(key, &member, 0);
    } else {
      reader.Required(key, &member);
    }
  };
  VisitConfig(*config, read);
  RETURN_IF_ERROR(RefuseInt8(object));
  reader.Optional("arithmetic", &config->arithmetic);
  reader.Optional("observation_changes", &config->observation_changes);
  reader.Optional("norm", &config->norm);
  for (const auto& [key, name] : FormerChoices(*config)) {
    std::string received = name;
    reader.Required(key, &received);
    if (received != name) {
      return InvalidArgument(absl::StrCat("config.", key), name, Quoted(received));
    }
  }
  if (config->is_integer()) VisitIntegerConfig(*config, read);
  return reader.Finish();
}

std::string FormatActionSpace(const ActionSpace& space) {
  if (space.is_discrete()) return ordered_json({{"type", "Discrete"}, {"n", space.n}}).dump();
  return ordered_json({{"type", "Box"}, {"low", space.low}, {"high", space.high}}).dump();
}

absl::Status ParseActionSpace(const std::string& text, ActionSpace* space) {
  ASSIGN_OR_RETURN(const Json object, ParseJsonObject("action_space", text));
  JsonObject reader("action_space", object);
  Json type;
  reader.Optional("type", &type);
  if (type == "Discrete") {
    reader.Required("n", &space->n, 0);
  } else if (type == "Box") {
    reader.Required("low", &space->low);
    reader.Required("high", &space->high);
  } else {
    return InvalidArgument("action_space.type", "\"Discrete\" or \"Box\"",
                           type.is_null() ? "none" : Describe(type));
  }
  return reader.Finish();
}

// Reads the keys that a file may leave out.
absl::Status ParseDescription(const std::map<std::string, std::string>& metadata, Policy* policy) {
  if (const auto found = metadata.find("features"); found != metadata.end()) {
    ASSIGN_OR_RETURN(policy->features, ParseFeatures(found->second));
  }
  if (const auto found = metadata.find("wiring"); found != metadata.end()) {
    ASSIGN_OR_RETURN(auto wiring, ParseWiringModel(found->second));
    policy->wiring = std::make_shared<const WiringModel>(std::move(wiring));
  }
  return absl::OkStatus();
}

}  // namespace

std::map<std::string, std::string> FormatPolicyMetadata(const Policy& policy) {
  std::map<std::string, std::string> metadata = {
      {"format", kFormat},
      {"config", FormatConfig(policy.config)},
      {"action_space", FormatActionSpace(policy.action_space)},
      {"environment", policy.environment},
      {"training", policy.training},
  };
  VisitNumbers(policy,
               [&metadata](const char* key, float number) { metadata[key] = Format(number); });
  // Files without these keys name nothing, and earlier versions ignore them.
  if (!policy.features.empty()) metadata["features"] = FormatFeatures(policy.features);
  if (policy.wiring != nullptr) metadata["wiring"] = FormatWiringModel(*policy.wiring);
  return metadata;
}

absl::Status ParsePolicyMetadata(const std::map<std::string, std::string>& metadata,
                                 Policy* policy) {
  absl::Status status;
  // Returns the value of a key. Returns an empty string and sets `status` if there is no such key.
  const auto take = [&](const char* key) {
    const auto found = metadata.find(key);
    if (found != metadata.end()) return found->second;
    status.Update(InvalidArgument("__metadata__", absl::StrCat("key \"", key, "\""), "none"));
    return std::string();
  };
  const std::string format = take("format");
  if (status.ok() && format != kFormat) {
    return InvalidArgument("format", Quoted(kFormat), Quoted(format));
  }
  const std::string config = take("config");
  const std::string action_space = take("action_space");
  policy->environment = take("environment");
  policy->training = take("training");
  VisitNumbers(*policy, [&](const char* key, float& number) {
    status.Update(Parse(key, take(key), &number));
  });
  status.Update(ParseConfig(config, &policy->config));
  status.Update(ParseActionSpace(action_space, &policy->action_space));
  status.Update(ParseDescription(metadata, policy));
  return status;
}

}  // namespace spikeserve
