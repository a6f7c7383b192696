#include "core/model/policy_metadata.h"

#include <charconv>
#include <cmath>
#include <limits>
#include <set>
#include <type_traits>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/base/json.h"

namespace spikeserve {
namespace {

using nlohmann::json;
using nlohmann::ordered_json;

constexpr char kFormat[] = "spikeserve.policy.v1";

// The keys of `config`, for the reader and the writer: visit(key, member). `Config` is ModelConfig,
// const or not.
template <typename Config, typename Visitor>
void VisitConfig(Config& config, Visitor&& visit) {
  visit("mode", config.mode);
  visit("hidden_size", config.hidden_size);
  visit("heads", config.heads);
  visit("layers", config.layers);
  visit("ticks", config.ticks);
  visit("context", config.context);
  visit("routing_hidden_size", config.routing_hidden_size);
  visit("ffn_size", config.ffn_size);
  visit("membrane_decay", config.membrane_decay);
  visit("threshold", config.threshold);
  visit("coder", config.coder);
  visit("phase_clock", config.phase_clock);
  visit("merge", config.merge);
  visit("gate", config.gate);
}

// The numbers that stand beside `config`: visit(key, member).
template <typename AnyPolicy, typename Visitor>
void VisitNumbers(AnyPolicy& policy, Visitor&& visit) {
  visit("return_offset", policy.return_offset);
  visit("return_scale", policy.return_scale);
  visit("target_return", policy.target_return);
  visit("modulator_mean", policy.modulator_mean);
  visit("modulator_std", policy.modulator_std);
}

absl::Status FieldError(absl::string_view field, absl::string_view expected,
                        absl::string_view received) {
  return absl::InvalidArgumentError(
      absl::StrCat(field, ": expected ", expected, ", received ", received));
}

absl::Status Parse(absl::string_view field, const json& value, int* number) {
  constexpr int kLargest = std::numeric_limits<int>::max();
  if (!value.is_number_unsigned() || value.get<uint64_t>() > kLargest) {
    return FieldError(field, absl::StrCat("an integer from 0 to ", kLargest), Describe(value));
  }
  *number = value.get<int>();
  return absl::OkStatus();
}

absl::Status Parse(absl::string_view field, const json& value, float* number) {
  constexpr double kLargest = std::numeric_limits<float>::max();
  if (!value.is_number() || std::abs(value.get<double>()) > kLargest) {
    return FieldError(field, "a number that fits float32", Describe(value));
  }
  *number = value.get<float>();
  return absl::OkStatus();
}

absl::Status Parse(absl::string_view field, const json& value, std::vector<float>* numbers) {
  if (!value.is_array()) return FieldError(field, "an array of numbers", Describe(value));
  numbers->resize(value.size());
  for (size_t i = 0; i < value.size(); ++i) {
    absl::Status status = Parse(absl::StrCat(field, "[", i, "]"), value[i], &(*numbers)[i]);
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

template <NamedEnum Enum>
absl::Status Parse(absl::string_view field, const json& value, Enum* choice) {
  if (!value.is_string()) return FieldError(field, "a string", Describe(value));
  const absl::StatusOr<Enum> parsed = ParseEnum<Enum>(field, value.get_ref<const std::string&>());
  if (parsed.ok()) *choice = *parsed;
  return parsed.status();
}

// Numbers that are metadata of their own are strings.
absl::Status Parse(absl::string_view field, const std::string& text, float* number) {
  const char* const end = text.data() + text.size();
  const auto [rest, error] = std::from_chars(text.data(), end, *number);
  if (error == std::errc() && rest == end && std::isfinite(*number)) return absl::OkStatus();
  return FieldError(field, "a finite number that fits float32", Quoted(text));
}

std::string Format(float number) {
  char text[32];  // the shortest form that reads back as the same float32 has at most 15 characters
  const auto result = std::to_chars(text, text + sizeof(text), number);
  return std::string(text, result.ptr);
}

// Takes the members of a JSON object one by one, and remembers the first error and what it took.
class ObjectReader {
 public:
  ObjectReader(absl::string_view name, const json& object) : name_(name), object_(object) {}

  template <typename Member>
  void operator()(const char* key, Member& member) {
    if (const json* value = Find(key)) status_.Update(Parse(Path(key), *value, &member));
  }

  // The first error; a member that nobody asked for is one.
  absl::Status Finish() {
    for (const auto& item : object_.items()) {
      if (taken_.contains(item.key())) continue;
      status_.Update(FieldError(name_, "no other keys", Quoted(item.key())));
    }
    return status_;
  }

 private:
  std::string Path(const char* key) const { return absl::StrCat(name_, ".", key); }

  const json* Find(const char* key) {
    taken_.insert(key);
    const auto found = object_.find(key);
    if (found != object_.end()) return &*found;
    status_.Update(FieldError(name_, absl::StrCat("key \"", key, "\""), "none"));
    return nullptr;
  }

  const std::string name_;
  const json& object_;
  std::set<std::string> taken_;
  absl::Status status_;
};

std::string FormatConfig(const ModelConfig& config) {
  ordered_json object;
  VisitConfig(config, [&object](const char* key, const auto& value) {
    if constexpr (std::is_enum_v<std::decay_t<decltype(value)>>) {
      object[key] = std::string(ToString(value));
    } else {
      object[key] = value;  // a float32 as a double: exact
    }
  });
  return object.dump();
}

absl::Status ParseConfig(const std::string& text, ModelConfig* config) {
  const absl::StatusOr<json> object = ParseJsonObject("config", text);
  if (!object.ok()) return object.status();
  ObjectReader reader("config", *object);
  VisitConfig(*config, reader);
  return reader.Finish();
}

std::string FormatActionSpace(const ActionSpace& space) {
  if (space.is_discrete()) return ordered_json({{"type", "Discrete"}, {"n", space.n}}).dump();
  return ordered_json({{"type", "Box"}, {"low", space.low}, {"high", space.high}}).dump();
}

absl::Status ParseActionSpace(const std::string& text, ActionSpace* space) {
  absl::StatusOr<json> object = ParseJsonObject("action_space", text);
  if (!object.ok()) return object.status();
  const json type = object->value("type", json());
  object->erase("type");
  ObjectReader reader("action_space", *object);
  if (type == "Discrete") {
    reader("n", space->n);
  } else if (type == "Box") {
    reader("low", space->low);
    reader("high", space->high);
  } else {
    return FieldError("action_space.type", "\"Discrete\" or \"Box\"",
                      type.is_null() ? "none" : Describe(type));
  }
  return reader.Finish();
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
  return metadata;
}

absl::Status ParsePolicyMetadata(const std::map<std::string, std::string>& metadata,
                                 Policy* policy) {
  absl::Status status;
  // The value of a key; empty, with an error in `status`, if there is none.
  const auto take = [&](const char* key) {
    const auto found = metadata.find(key);
    if (found != metadata.end()) return found->second;
    status.Update(FieldError("__metadata__", absl::StrCat("key \"", key, "\""), "none"));
    return std::string();
  };
  const std::string format = take("format");
  if (status.ok() && format != kFormat) {
    return FieldError("format", Quoted(kFormat), Quoted(format));
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
  return status;
}

}  // namespace spikeserve
