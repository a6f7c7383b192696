#include "core/action/reported_action.h"

#include <string>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

std::string DescribeAction(const ReportedAction& reported) {
  if (const auto* index = std::get_if<int64_t>(&reported)) return absl::StrCat("index ", *index);
  if (const auto* values = std::get_if<absl::Span<const float>>(&reported)) {
    return absl::StrCat(values->size(), " continuous values");
  }
  return "none";
}

absl::Status Refusal(const std::string& expected, const ReportedAction& reported) {
  return InvalidArgument("executed_action", expected, DescribeAction(reported));
}

absl::Status CheckSource(const ReportedSource& source) {
  if (source.kind < 0 || source.kind >= static_cast<int>(kSourceKinds)) {
    return InvalidArgument("executed_source.kind", absl::StrCat("0 to ", kSourceKinds - 1),
                           source.kind);
  }
  const auto kind = static_cast<SourceKind>(source.kind);
  const size_t most = kind == SourceKind::kOperator ? kLongestOperatorId : 0;
  if (source.operator_id.size() <= most) return absl::OkStatus();
  return InvalidArgument("executed_source.operator_id",
                         absl::StrCat("at most ", most, " bytes from ", ToString(kind)),
                         source.operator_id.size());
}

}  // namespace

absl::StatusOr<Action> ParseExecutedAction(const ReportedAction& reported,
                                           const ActionSpace& space) {
  RETURN_IF_ERROR(CheckSource(reported.source));
  if (space.is_discrete()) {
    const auto* index = std::get_if<int64_t>(&reported);
    if (index == nullptr || *index < 0 || *index >= space.n) {
      return Refusal(absl::StrCat("an index from 0 to ", space.n - 1), reported);
    }
    return Action{.discrete = static_cast<int>(*index), .continuous = {}};
  }
  const auto* values = std::get_if<absl::Span<const float>>(&reported);
  if (values == nullptr || values->size() != space.low.size()) {
    return Refusal(absl::StrCat(space.low.size(), " continuous values"), reported);
  }
  for (size_t i = 0; i < values->size(); ++i) {
    const float value = (*values)[i];
    if (value >= space.low[i] && value <= space.high[i]) continue;  // false for NaN
    // Nine digits distinguish any two float32 values.
    return absl::InvalidArgumentError(
        absl::StrFormat("executed_action[%d]: expected %.9g to %.9g, received %.9g", i,
                        space.low[i], space.high[i], value));
  }
  return Action{.discrete = 0, .continuous = {values->begin(), values->end()}};
}

}  // namespace spikeserve
