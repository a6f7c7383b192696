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
#include "server/policies/policy_repository.h"
#include "server/policies/policy_signatures.h"

namespace spikeserve {

// Writes `files` as a new version of the policy `name` and returns it. Its number is one above
// every version folder of the policy, also of those without a file. The files are written to a
// hidden folder, flushed to the disk and then renamed. On an error nothing is left behind.
absl::StatusOr<PolicyVersion> WriteNewVersion(const std::string& directory, const std::string& name,
                                              const VersionFiles& files);

// Writes a version in the same way. Returns the error of the system if it exists.
absl::Status WriteVersion(const std::string& directory, const PolicyVersion& version,
                          const VersionFiles& files);

// Returns the number one above every version folder of the policy `name`.
int64_t NextVersion(const std::string& directory, const std::string& name);

// Removes what killed processes have left in the policy directory: the hidden folders of
// WriteNewVersion() that no process writes to, temporary files of policies that are older than ten
// minutes, and empty version folders. What cannot be removed stays.
void SweepUnfinishedVersions(const std::string& directory);

}  // namespace spikeserve

#endif  // SERVER_POLICIES_VERSION_WRITER_H_
