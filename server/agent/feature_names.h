// Compares what a robot says about its elements with the features of the policy that it opens.
#ifndef SERVER_AGENT_FEATURE_NAMES_H_
#define SERVER_AGENT_FEATURE_NAMES_H_

#include "absl/status/status.h"
#include "core/model/features.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Returns INVALID_ARGUMENT, which names the field, if a name, a unit or the rate of `request`
// differs from `features`, or if they have none to compare it with. Thread-safe.
absl::Status CheckFeatures(const v1::OpenSessionRequest& request, const Features& features);

}  // namespace spikeserve

#endif  // SERVER_AGENT_FEATURE_NAMES_H_
