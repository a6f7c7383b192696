// Chooses the policy version of an agent from those that a server serves.
//
// Free functions, safe to call from many threads.
#pragma once

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/environment/environment.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Returns version `version` (0: the default version) of the policy `name`. If `name` is empty,
// chooses the policy that was trained for `environment`, and the first by name if there are
// several. Returns NOT_FOUND, which lists the policies that are served.
absl::StatusOr<v1::PolicyInfo> ChoosePolicy(const v1::ListPoliciesResponse& served,
                                            const std::string& environment, const std::string& name,
                                            int64_t version);

// Returns INVALID_ARGUMENT unless the policy has the observation size and the action space of
// `environment`.
absl::Status CheckSpacesMatch(const v1::PolicyInfo& policy, const Environment& environment);

}  // namespace spikeserve
