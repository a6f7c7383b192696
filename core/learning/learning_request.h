// The learning that a caller requests for a session, before defaults and checks.
//
// Plain values; free functions without shared state.
#pragma once

#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "core/learning/learning_options.h"

namespace spikeserve {

// Empty names and absent numbers select the defaults of LearningOptions.
struct LearningRequest {
  Scope scope = Scope::kSession;
  std::string rule;
  std::string modulator;
  std::optional<double> learning_rate = std::nullopt;
  std::optional<double> trace_decay = std::nullopt;
  std::optional<double> discount = std::nullopt;
  std::optional<double> clip = std::nullopt;
  std::optional<double> max_drift = std::nullopt;
  std::optional<double> guard_margin = std::nullopt;
  std::optional<double> verdict_seconds = std::nullopt;
};

// Returns the options that `request` asks for. Returns INVALID_ARGUMENT for an unknown name, for a
// field that would have no effect, and for options that LearningOptions::Validate refuses.
absl::StatusOr<LearningOptions> ResolveLearning(const LearningRequest& request,
                                                const ActionSpace& space,
                                                const ActionSelection& selection);

}  // namespace spikeserve
