// Converts all of a policy except its weights to and from the `__metadata__` strings of a policy
// file.
//
// All functions are pure and thread-safe.
#pragma once

#include <map>
#include <string>

#include "absl/status/status.h"
#include "core/model/policy.h"

namespace spikeserve {

// Returns the metadata of `policy`. A number is formatted so that parsing it gives the same
// float32. REQUIRES: a valid policy.
std::map<std::string, std::string> FormatPolicyMetadata(const Policy& policy);

// Sets all of `policy` except its weights. INVALID_ARGUMENT, naming the field, if a key is missing,
// a value cannot be parsed, or `config` or `action_space` contains an unknown key; other unknown
// keys are ignored. Policy::Validate checks whether the values are consistent.
absl::Status ParsePolicyMetadata(const std::map<std::string, std::string>& metadata,
                                 Policy* policy);

}  // namespace spikeserve
