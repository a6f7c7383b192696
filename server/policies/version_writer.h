// Adds versions to the policy directory, so that a version is either there completely or not at
// all.
//
// Free functions without shared state; safe to call from many threads, and while other servers use
// the same directory.
#ifndef SERVER_POLICIES_VERSION_WRITER_H_
#define SERVER_POLICIES_VERSION_WRITER_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/model/policy.h"
#include "server/policies/policy_repository.h"

namespace spikeserve {

// Writes `policy` as a new version of the policy `name` and returns it. Its number is one above
// every version folder of the policy, also of those without a file. The version is written to a
// hidden folder, flushed to the disk and then renamed. On an error nothing is left behind.
absl::StatusOr<PolicyVersion> WriteNewVersion(const std::string& directory, const std::string& name,
                                              const Policy& policy);

// Writes the version with the content `bytes` of its file. INVALID_ARGUMENT if their SHA-256 is not
// `sha256`, ALREADY_EXISTS if there is such a version.
absl::Status WriteVersion(const std::string& directory, const PolicyVersion& version,
                          const std::string& bytes, const std::string& sha256);

// Returns the content of the file of `policy`. Uses a temporary file in the folder of the policy
// `name`.
absl::StatusOr<std::string> PolicyFileBytes(const std::string& directory, const std::string& name,
                                            const Policy& policy);

// Returns the number one above every version folder of the policy `name`.
int64_t NextVersion(const std::string& directory, const std::string& name);

// Removes what killed processes have left in the policy directory: the hidden folders of
// WriteNewVersion() that no process writes to, temporary files of policies that are older than ten
// minutes, and empty version folders. What cannot be removed stays.
void SweepUnfinishedVersions(const std::string& directory);

}  // namespace spikeserve

#endif  // SERVER_POLICIES_VERSION_WRITER_H_
