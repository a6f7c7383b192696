#include "core/learning/learning_options.h"

#include <cmath>
#include <initializer_list>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

absl::Status CheckPositive(const char* field, double value) {
  if (std::isfinite(value) && value > 0.0) return absl::OkStatus();
  return InvalidArgument(absl::StrCat("learning.", field), "a finite number above 0", value);
}

absl::Status CheckFraction(const char* field, double value) {
  if (value >= 0.0 && value <= 1.0) return absl::OkStatus();
  return InvalidArgument(absl::StrCat("learning.", field), "a number from 0 to 1", value);
}

}  // namespace

absl::Status LearningOptions::Validate(const ActionSpace& space,
                                       const ActionSelection& selection) const {
  RETURN_IF_ERROR(CheckPositive("learning_rate", learning_rate));
  RETURN_IF_ERROR(CheckFraction("trace_decay", trace_decay));
  RETURN_IF_ERROR(CheckFraction("discount", discount));
  RETURN_IF_ERROR(CheckPositive("clip", clip));
  RETURN_IF_ERROR(CheckPositive("max_drift", max_drift));
  if (!(std::isfinite(guard_margin) && guard_margin >= 0.0)) {
    return InvalidArgument("learning.guard_margin", "a finite number of at least 0", guard_margin);
  }
  if (!(verdict_seconds >= 0.0 && verdict_seconds <= kLongestWait)) {
    return InvalidArgument("learning.verdict_seconds",
                           absl::StrCat("a number from 0 to ", kLongestWait), verdict_seconds);
  }
  if (rule == Rule::kPolicyGradient && !space.is_discrete() && !selection.sample) {
    return absl::InvalidArgumentError(
        "learning.rule: expected hebbian or hebbian_action, or action_selection SAMPLE, since a "
        "greedy continuous action has no score to learn from; received policy_gradient with "
        "GREEDY");
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
