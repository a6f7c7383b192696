#include "core/agent/session_request.h"

#include <cmath>
#include <limits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/learning/frobenius_norm.h"
#include "core/learning/head_update.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

absl::StatusOr<ActionSelection> ResolveSelection(const SessionRequest& request) {
  ActionSelection selection = {.sample = request.sample};
  if (!request.temperature.has_value()) return selection;
  if (!selection.sample) {
    return InvalidArgument("temperature", "unset unless action_selection is SAMPLE",
                           *request.temperature);
  }
  // Decisions divide by the temperature in float32, where doubles below kSmallest are subnormal or
  // zero.
  constexpr double kSmallest = std::numeric_limits<float>::min();
  constexpr double kLargest = std::numeric_limits<float>::max();
  if (!(*request.temperature >= kSmallest && *request.temperature <= kLargest)) {
    return InvalidArgument("temperature", "a finite number above 0 within float32",
                           *request.temperature);
  }
  selection.temperature = static_cast<float>(*request.temperature);
  return selection;
}

absl::Status CheckHeadDelta(const SessionRequest& request, const Policy& policy) {
  const Eigen::VectorXf& delta = request.head_delta;
  if (delta.size() == 0) return absl::OkStatus();
  if (request.learning.has_value() && request.learning->scope == Scope::kFleet) {
    return InvalidArgument("head_delta", "none where learning.scope is FLEET",
                           absl::StrCat(delta.size(), " numbers"));
  }
  const auto size = static_cast<Eigen::Index>(policy.weights.head.weight.values.size());
  if (delta.size() != size) {
    return InvalidArgument("head_delta", absl::StrCat(size, " numbers"), delta.size());
  }
  for (Eigen::Index i = 0; i < size; ++i) {
    if (std::isfinite(delta[i])) continue;
    return InvalidArgument(absl::StrCat("head_delta[", i, "]"), "a finite number", delta[i]);
  }
  if (const double norm = FrobeniusNorm(delta); norm > kLongestHeadDelta) {
    return InvalidArgument("head_delta",
                           absl::StrCat("a Frobenius norm of at most ", kLongestHeadDelta), norm);
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<SessionOptions> ResolveSession(SessionRequest request, const ServedPolicy& served) {
  const Policy& policy = served.policy();
  SessionOptions options;
  options.policy = served.name;
  options.version = served.version;
  options.seed = request.seed;
  options.target_return = request.target_return.value_or(static_cast<double>(policy.target_return));
  RETURN_IF_ERROR(CheckTargetReturn(options.target_return));
  ASSIGN_OR_RETURN(const auto selection, ResolveSelection(request));
  options.action_selection = selection;
  if (request.learning.has_value()) {
    ASSIGN_OR_RETURN(options.learning,
                     ResolveLearning(*request.learning, policy.action_space, selection));
  }
  RETURN_IF_ERROR(CheckHeadDelta(request, policy));
  options.head_delta = std::move(request.head_delta);
  return options;
}

}  // namespace spikeserve
