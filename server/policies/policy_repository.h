// Reads the policy directory: DIR/<policy>/<version>/policy.safetensors.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <compare>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/head_log.h"
#include "core/agent/served_policy.h"
#include "core/engine/engine.h"
#include "server/policies/policy_signatures.h"

namespace spikeserve {

struct PolicyVersion {
  std::string policy;
  int64_t version = 0;

  friend auto operator<=>(const PolicyVersion&, const PolicyVersion&) = default;
};

// Identifies the state of a file. Two stamps differ if the file was replaced or written in between.
struct FileStamp {
  int64_t modified_ns = 0;
  uint64_t inode = 0;
  int64_t size = -1;  // bytes; -1 if there is no file

  friend bool operator==(const FileStamp&, const FileStamp&) = default;
};

FileStamp StampOf(const std::string& path);

// The contents of a policy directory.
struct PolicyFolders {
  std::vector<PolicyVersion> versions;  // by policy, then version
  std::vector<absl::Status> refused;    // folders with invalid names; messages start with the path
};

// Returns the version that a folder stands for, by its name: decimal digits without a leading zero,
// so that no two folders stand for the same version. Returns INVALID_ARGUMENT for any other name.
absl::StatusOr<int64_t> ParseVersion(const std::filesystem::path& folder);

// Lists the policies and versions in `directory`, without empty version folders; links that lead
// out of it are refused. Returns NOT_FOUND if there is no such directory.
absl::StatusOr<PolicyFolders> ListPolicyFolders(const std::string& directory);

// Explains why nothing of `directory` can be served and what to do: names the directory that was
// probably meant if `directory` is one level too deep or too high, else the first of `refused`.
std::string ExplainNoPolicies(const std::string& directory,
                              const std::vector<absl::Status>& refused);

// The longest name of a policy or a label, in bytes.
inline constexpr size_t kLongestName = 128;

// Returns true if `name` is valid for a policy or a label: at most kLongestName letters, digits,
// '.', '-' and '_', not starting with '.'. Names become part of paths and metric labels.
bool IsPlainName(const std::string& name);

std::string PolicyFilePath(const std::string& directory, const PolicyVersion& version);

// Makes the observer of one policy version.
using NewObserver = std::function<std::shared_ptr<SessionObserver>(
    const std::string& name, int64_t version, const Policy& policy)>;

// Verifies the signature of a version unless `signatures` is null, parses it, and makes one
// decision with it, so that all data that a decision touches is in memory. Returns the errors of
// PolicySignatures::Verify and ParsePolicyFile, and INVALID_ARGUMENT if the decision is not finite.
absl::StatusOr<std::shared_ptr<const Engine>> TryVersion(const PolicyVersion& version,
                                                         const VersionFiles& files,
                                                         const PolicySignatures* signatures);

// Reads a version and tries it. Returns the errors of ReadVersionFiles and TryVersion; messages
// start with the path. `signatures`: see TryVersion.
// `learning` pauses this version together with the others that share the switch. `share_heads`: the
// fleet sessions of all tenants learn one head; otherwise each tenant has its own. `open_log` opens
// the log that changes the heads; null: they are those of this process alone.
absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadPolicyVersion(
    const std::string& directory, const PolicyVersion& version, const PolicySignatures* signatures,
    std::shared_ptr<LearningSwitch> learning, const NewObserver& new_observer,
    bool share_heads = false, const OpenHeadLog& open_log = nullptr);

}  // namespace spikeserve
