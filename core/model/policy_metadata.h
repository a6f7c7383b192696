// The `__metadata__` of a policy file: everything of a policy but its weights, as strings.
//
// Free functions without shared state; safe to call from many threads.
#ifndef CORE_MODEL_POLICY_METADATA_H_
#define CORE_MODEL_POLICY_METADATA_H_

#include <map>
#include <string>

#include "absl/status/status.h"
#include "core/model/policy.h"

namespace spikeserve {

// Numbers are written so that reading them gives the same float32. REQUIRES: a valid policy.
std::map<std::string, std::string> FormatPolicyMetadata(const Policy& policy);

// Fills in all of `policy` but its weights. INVALID_ARGUMENT names the field: every key must be
// there, and `config` and `action_space` may hold no others; other annotations beside them are left
// alone. What the values mean together is for Policy::Validate.
absl::Status ParsePolicyMetadata(const std::map<std::string, std::string>& metadata,
                                 Policy* policy);

}  // namespace spikeserve

#endif  // CORE_MODEL_POLICY_METADATA_H_
