// Reads and writes policy files: safetensors with the metadata of a policy (`format` =
// `spikeserve.policy.v1`).
//
// All functions are thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/model/policy.h"

namespace spikeserve {

// Reads and validates a policy. Strict: a missing, unknown or misshapen tensor, another dtype than
// the config's arithmetic requires, a number that is not finite or out of range, an unknown key in
// `config` or a malformed container is an error. NOT_FOUND if there is no such file,
// INVALID_ARGUMENT otherwise; messages start with the path.
absl::StatusOr<Policy> ReadPolicyFile(const std::string& path);

// As above, of the bytes of a file. Messages do not name a path.
absl::StatusOr<Policy> ParsePolicyFile(absl::string_view bytes);

// Returns the content of the file of `policy`. INVALID_ARGUMENT if the policy is not valid.
absl::StatusOr<std::string> FormatPolicyFile(const Policy& policy);

// Writes `policy` to a temporary file in the same directory and renames it to `path`, so that a
// reader never sees a part of a policy. INVALID_ARGUMENT if the policy is not valid; in that case
// nothing is written.
absl::Status WritePolicyFile(const Policy& policy, const std::string& path);

}  // namespace spikeserve
