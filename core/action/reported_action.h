// Checks the actions that agents report as executed, for example after a safety layer has clipped
// the answered action.
//
// Free functions, safe to call from many threads.
#pragma once

#include <cstdint>
#include <variant>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/action/step_source.h"

namespace spikeserve {

// An action as a client sends it: nothing, an index, or values in environment units; and who chose
// it.
struct ReportedAction : std::variant<std::monostate, int64_t, absl::Span<const float>> {
  using variant::variant;

  ReportedSource source = {};
};

// Converts `reported` to an action of `space`. Returns INVALID_ARGUMENT, which names the field
// executed_action and the element, for another kind of action, an index out of range, another
// number of values, and a value that is not finite or lies outside its bounds by any amount; and
// executed_source, for an unknown kind, and an operator's name that is too long or not an
// operator's.
absl::StatusOr<Action> ParseExecutedAction(const ReportedAction& reported,
                                           const ActionSpace& space);

}  // namespace spikeserve
