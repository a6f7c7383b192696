#include "core/learning/learning_request.h"

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

// Refuses fields that would have no effect with the other options.
absl::Status CheckApplies(const LearningRequest& request, const LearningOptions& options) {
  const auto unset = [](const char* field, absl::string_view unless, double received) {
    return InvalidArgument(absl::StrCat("learning.", field), absl::StrCat("unset unless ", unless),
                           received);
  };
  if (options.rule == Rule::kCorrections) {
    const char* const unless = "rule learns from rewards";
    if (!request.modulator.empty()) {
      return absl::InvalidArgumentError(absl::StrCat("learning.modulator: expected unset unless ",
                                                     unless, ", received ", request.modulator));
    }
    if (request.discount.has_value()) return unset("discount", unless, *request.discount);
    if (request.trace_decay.has_value()) return unset("trace_decay", unless, *request.trace_decay);
    if (request.verdict_seconds.has_value()) {
      return unset("verdict_seconds", unless, *request.verdict_seconds);
    }
  }
  if (request.verdict_seconds.has_value() && options.modulator != Modulator::kRealized) {
    return unset("verdict_seconds", "modulator is realized", *request.verdict_seconds);
  }
  if (request.discount.has_value() && options.modulator != Modulator::kRealized) {
    return unset("discount", "modulator is realized", *request.discount);
  }
  if (options.scope == Scope::kSession) return absl::OkStatus();
  if (request.max_drift.has_value()) {
    return unset("max_drift", "scope is SESSION, because the server bounds shared heads",
                 *request.max_drift);
  }
  if (request.guard_margin.has_value()) {
    return unset("guard_margin", "scope is SESSION, because the server guards shared heads",
                 *request.guard_margin);
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<LearningOptions> ResolveLearning(const LearningRequest& request,
                                                const ActionSpace& space,
                                                const ActionSelection& selection) {
  LearningOptions options;
  options.scope = request.scope;
  if (!request.rule.empty()) {
    ASSIGN_OR_RETURN(options.rule, ParseEnum<Rule>("learning.rule", request.rule));
  }
  if (!request.modulator.empty()) {
    ASSIGN_OR_RETURN(options.modulator,
                     ParseEnum<Modulator>("learning.modulator", request.modulator));
  }
  RETURN_IF_ERROR(CheckApplies(request, options));
  options.learning_rate = request.learning_rate.value_or(
      LearningOptions::DefaultLearningRate(options.rule, options.modulator));
  options.trace_decay = request.trace_decay.value_or(options.trace_decay);
  options.discount = request.discount.value_or(options.discount);
  options.clip = request.clip.value_or(options.clip);
  options.max_drift = request.max_drift.value_or(options.max_drift);
  options.guard_margin = request.guard_margin.value_or(options.guard_margin);
  options.verdict_seconds = request.verdict_seconds.value_or(options.verdict_seconds);
  RETURN_IF_ERROR(options.Validate(space, selection));
  return options;
}

}  // namespace spikeserve
