// Defines who chose the action that a robot executed at a step. Plain values.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"

namespace spikeserve {

// The numbers are those of v1::ActionSource::Kind, which says what each one is.
enum class SourceKind : uint8_t {
  kUnknown,
  kPolicy,
  kOperator,
  kSafetyLayer,
  kHeld,
  kLocal,
  kSafe,
  kHold
};
inline constexpr size_t kSourceKinds = 8;

constexpr std::array<EnumName<SourceKind>, kSourceKinds> EnumNames(SourceKind) {
  return {{{SourceKind::kUnknown, "unknown"},
           {SourceKind::kPolicy, "policy"},
           {SourceKind::kOperator, "operator"},
           {SourceKind::kSafetyLayer, "safety_layer"},
           {SourceKind::kHeld, "held"},
           {SourceKind::kLocal, "local"},
           {SourceKind::kSafe, "safe"},
           {SourceKind::kHold, "hold"}}};
}

struct StepSource {
  SourceKind kind = SourceKind::kPolicy;
  std::string operator_id = {};  // kOperator only

  friend bool operator==(const StepSource&, const StepSource&) = default;
};

// Returns the kind, with the name of an operator that has one: "policy", "operator:anna".
inline std::string ToString(const StepSource& source) {
  const absl::string_view separator = source.operator_id.empty() ? "" : ":";
  return absl::StrCat(ToString(source.kind), separator, source.operator_id);
}

// As a client says it, not checked yet.
struct ReportedSource {
  int kind = 0;  // 0: the policy, if the action is the answered one
  absl::string_view operator_id = {};
};

inline constexpr size_t kLongestOperatorId = 128;  // bytes

}  // namespace spikeserve
