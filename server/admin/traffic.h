// Describes how the traffic of a policy is divided.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "server/policies/policy_registry.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

// Returns an empty message if the policy is not served.
v1::Traffic TrafficOf(const PolicyCatalog& catalog, const std::string& policy);

// Runs `change` and fills in the traffic of the policy before and after it. Returns the status of
// `change`.
absl::Status ChangeTraffic(const PolicyRegistry& registry, const std::string& policy,
                           v1::TrafficChange* traffic, absl::FunctionRef<absl::Status()> change);

}  // namespace spikeserve
