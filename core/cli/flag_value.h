// Converts between the values of flags and their texts, for every type that a flag can have.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/str_join.h"
#include "absl/strings/strip.h"
#include "absl/time/time.h"
#include "core/base/enum_names.h"

namespace spikeserve {

// Parse `text` and store the value. Return INVALID_ARGUMENT with the message "expected X, received
// Y" if that fails.
absl::Status ParseFlagValue(const std::string& text, std::string* value);
absl::Status ParseFlagValue(const std::string& text, int32_t* value);
absl::Status ParseFlagValue(const std::string& text, int64_t* value);
absl::Status ParseFlagValue(const std::string& text, uint64_t* value);
absl::Status ParseFlagValue(const std::string& text, float* value);
absl::Status ParseFlagValue(const std::string& text, double* value);
absl::Status ParseFlagValue(const std::string& text, bool* value);
absl::Status ParseFlagValue(const std::string& text, absl::Duration* value);  // 250ms, 10s, 1.5m
template <NamedEnum Enum>
absl::Status ParseFlagValue(const std::string& text, Enum* value) {
  const absl::StatusOr<Enum> parsed = ParseEnum<Enum>("", text);
  if (parsed.ok()) *value = *parsed;
  return parsed.ok()
             ? absl::OkStatus()
             : absl::InvalidArgumentError(absl::StripPrefix(parsed.status().message(), ": "));
}
template <typename T>
absl::Status ParseFlagValue(const std::string& text, std::optional<T>* value) {
  return ParseFlagValue(text, &value->emplace());
}

// Return the text of a default value; empty if there is no default.
std::string FlagValueText(const std::string& value);
std::string FlagValueText(bool value);
std::string FlagValueText(int32_t value);
std::string FlagValueText(int64_t value);
std::string FlagValueText(uint64_t value);
std::string FlagValueText(float value);
std::string FlagValueText(double value);
std::string FlagValueText(absl::Duration value);
template <NamedEnum Enum>
std::string FlagValueText(Enum value) {
  return std::string(ToString(value));
}
template <typename T>
std::string FlagValueText(const std::optional<T>& value) {
  return value.has_value() ? FlagValueText(*value) : "";
}

// Returns the names of the values of an enumeration as the kind of a flag: a|b|c.
template <NamedEnum Enum>
std::string EnumKind() {
  return absl::StrJoin(EnumNames(Enum()), "|", [](std::string* out, const EnumName<Enum>& entry) {
    out->append(entry.name.data(), entry.name.size());
  });
}

}  // namespace spikeserve
