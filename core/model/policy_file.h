// Policy files: safetensors with the metadata of a policy (`format` = `spikeserve.policy.v1`).
//
// Free functions without shared state; safe to call from many threads.
#ifndef CORE_MODEL_POLICY_FILE_H_
#define CORE_MODEL_POLICY_FILE_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/model/policy.h"

namespace spikeserve {

// Reads and checks a whole policy. Nothing is guessed: a missing, unknown or misshapen tensor, a
// dtype other than F32, a number that is not finite, an unknown metadata key of `config` or a
// broken container is an error whose message starts with the path. NOT_FOUND if there is no such
// file, INVALID_ARGUMENT otherwise.
absl::StatusOr<Policy> ReadPolicyFile(const std::string& path);

// Writes to a temporary file beside `path`, then renames it, so that a reader never sees half a
// policy. INVALID_ARGUMENT if the policy is not valid (nothing is written).
absl::Status WritePolicyFile(const Policy& policy, const std::string& path);

}  // namespace spikeserve

#endif  // CORE_MODEL_POLICY_FILE_H_
