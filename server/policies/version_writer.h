// Adds versions to the policy directory, and removes them, so that a version is either there
// completely or not at all.
//
// An empty file `pushed` in the folder of a version says that a server has written it for
// PushPolicy.
//
// Free functions without shared state; safe to call from many threads, and while other servers use
// the same directory.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/policies/policy_repository.h"
#include "server/policies/policy_signatures.h"

namespace spikeserve {

// Writes the files of a version to a hidden folder, flushes them to the disk and renames the
// folder. Returns the error of the system, and leaves nothing behind, also if the version exists.
absl::Status WriteVersion(const std::string& directory, const PolicyVersion& version,
                          const VersionFiles& files);

// Removes a version. Returns how many bytes its files had, or the error of the system.
absl::StatusOr<int64_t> RemoveVersion(const std::string& directory, const PolicyVersion& version);

// Returns true if a version was pushed.
bool IsPushed(const std::string& directory, const PolicyVersion& version);

// Returns the versions of the policy `name` that have a folder, also one without a file, ascending.
std::vector<int64_t> VersionsOf(const std::string& directory, const std::string& name);

// Removes what killed processes have left in the policy directory: the hidden folders of
// WriteVersion() that no process writes to, temporary files of policies that are older than ten
// minutes, and empty version folders. What cannot be removed stays.
void SweepUnfinishedVersions(const std::string& directory);

}  // namespace spikeserve
