// The settings that a caller requests for a new session, before defaults and checks. The server and
// the Python engine both open sessions with it.
//
// Plain values; free functions without shared state.
#pragma once

#include <cstdint>
#include <optional>

#include "Eigen/Core"
#include "absl/status/statusor.h"
#include "core/agent/served_policy.h"
#include "core/learning/learning_request.h"
#include "core/session/session.h"

namespace spikeserve {

// Absent values select the defaults of the policy.
struct SessionRequest {
  std::optional<double> target_return = std::nullopt;
  uint64_t seed = 0;
  bool sample = false;
  std::optional<double> temperature = std::nullopt;  // requires `sample`
  std::optional<LearningRequest> learning = std::nullopt;
  Eigen::VectorXf head_delta = {};  // as SessionOptions::head_delta
};

// Returns the options of a session on `served` without labels and tenant. Returns INVALID_ARGUMENT,
// which names the field, for a value that is out of its range or would have no effect.
absl::StatusOr<SessionOptions> ResolveSession(SessionRequest request, const ServedPolicy& served);

}  // namespace spikeserve
