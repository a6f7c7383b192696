// Converts enumeration values to and from the names that files, messages and command lines use.
//
// An enumeration declares its names with one overload of EnumNames() beside its definition:
//
//   enum class Gate { kSoftmax, kSigmoid };
//   constexpr std::array<EnumName<Gate>, 2> EnumNames(Gate) {
//     return {{{Gate::kSoftmax, "softmax"}, {Gate::kSigmoid, "sigmoid"}}};
//   }
//
// ToString(Gate::kSigmoid) then returns "sigmoid", and ParseEnum<Gate>("gate", "sigmoid") returns
// Gate::kSigmoid. All functions are pure and thread-safe.
#pragma once

#include <array>
#include <cstddef>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/json.h"
#include "core/base/status.h"

namespace spikeserve {

template <typename Enum>
struct EnumName {
  Enum value;
  absl::string_view name;
};

// Is satisfied by enumerations that have an overload of EnumNames().
template <typename Enum>
concept NamedEnum = requires(Enum value) {
  EnumNames(value);
};

// Returns the name of `value`, or "invalid" if it is not one of the enumeration's values.
template <NamedEnum Enum>
constexpr absl::string_view ToString(Enum value) {
  for (const EnumName<Enum>& entry : EnumNames(value)) {
    if (entry.value == value) return entry.name;
  }
  return "invalid";
}

// Returns the value whose name is `name`. INVALID_ARGUMENT if there is none, with the message
// "`field`: expected a, b or c, received ...".
template <NamedEnum Enum>
absl::StatusOr<Enum> ParseEnum(absl::string_view field, absl::string_view name) {
  constexpr auto kNames = EnumNames(Enum());
  std::string expected;
  for (size_t i = 0; i < kNames.size(); ++i) {
    if (kNames[i].name == name) return kNames[i].value;
    const char* const separator = i == 0 ? "" : i + 1 == kNames.size() ? " or " : ", ";
    absl::StrAppend(&expected, separator, kNames[i].name);
  }
  return InvalidArgument(field, expected, Quoted(name));
}

}  // namespace spikeserve
