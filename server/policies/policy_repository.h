// The policy directory: DIR/<policy>/<version>/policy.safetensors.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_POLICIES_POLICY_REPOSITORY_H_
#define SERVER_POLICIES_POLICY_REPOSITORY_H_

#include <compare>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/session/served_policy.h"

namespace spikeserve {

struct PolicyVersion {
  std::string policy;
  int64_t version = 0;

  friend auto operator<=>(const PolicyVersion&, const PolicyVersion&) = default;
};

// Tells whether a file was replaced or written to.
struct FileStamp {
  int64_t modified_ns = 0;
  uint64_t inode = 0;
  int64_t size = -1;  // -1: there is no file

  friend bool operator==(const FileStamp&, const FileStamp&) = default;
};

FileStamp StampOf(const std::string& path);

// What a policy directory holds.
struct PolicyFolders {
  std::vector<PolicyVersion> versions;  // by policy, then version
  std::vector<absl::Status> refused;    // folders whose names say nothing; paths come first
};

// NOT_FOUND if there is no such directory.
absl::StatusOr<PolicyFolders> ListPolicyFolders(const std::string& directory);

// Whether `name` may be that of a policy or a label: it becomes part of paths and metrics, so it
// stays plain.
bool IsPlainName(const std::string& name);

std::string PolicyFilePath(const std::string& directory, const PolicyVersion& version);

// Makes the observer of one policy version.
using NewObserver = std::function<std::shared_ptr<SessionObserver>(
    const std::string& name, int64_t version, const Policy& policy)>;

// Reads a version and decides once with it, so that whatever a first decision touches is there and
// a policy that cannot decide is refused here. Errors of ReadPolicyFile, whose message starts with
// the path. `learning` is what pauses the version, with all others that have it.
absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadPolicyVersion(
    const std::string& directory, const PolicyVersion& version,
    std::shared_ptr<LearningSwitch> learning, const NewObserver& new_observer);

}  // namespace spikeserve

#endif  // SERVER_POLICIES_POLICY_REPOSITORY_H_
