// Which of the policies served an agent asks for.
//
// Free functions, safe to call from many threads.
#ifndef CLIENT_SPIKECTL_POLICY_CHOICE_H_
#define CLIENT_SPIKECTL_POLICY_CHOICE_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/environment/environment.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// The version `version` (0: the default one) of the policy `name`; with an empty name, of the first
// policy by name that was trained for `environment`. NOT_FOUND tells what is served instead.
absl::StatusOr<v1::PolicyInfo> ChoosePolicy(const v1::ListPoliciesResponse& served,
                                            const std::string& environment, const std::string& name,
                                            int64_t version);

// INVALID_ARGUMENT unless the policy takes the environment's observations and answers with its
// actions.
absl::Status CheckFits(const v1::PolicyInfo& policy, const Environment& environment);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_POLICY_CHOICE_H_
