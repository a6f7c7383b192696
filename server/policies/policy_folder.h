// The policy directory: DIR/<policy>/<version>/policy.safetensors, and the signatures of its files.
//
// Versions that a server adds or removes are there completely or not at all. An empty file `pushed`
// in the folder of a version says that a server has written it for PushPolicy.
//
// Immutable and thread-safe, also while other servers use the same directory.
#pragma once

#include <array>
#include <compare>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/engine/engine.h"
#include "server/policies/policy_signatures.h"

namespace spikeserve {

struct PolicyVersion {
  std::string policy;
  int64_t version = 0;

  friend auto operator<=>(const PolicyVersion&, const PolicyVersion&) = default;
};

// Returns the version that a folder stands for, by its name: decimal digits without a leading zero,
// so that no two folders stand for the same version. Returns INVALID_ARGUMENT for any other name.
absl::StatusOr<int64_t> ParseVersion(const std::filesystem::path& folder);

// The longest name of a policy or a label, in bytes.
inline constexpr size_t kLongestName = 128;

// Returns true if `name` is valid for a policy or a label: at most kLongestName letters, digits,
// '.', '-' and '_', not starting with '.'. Names become part of paths and metric labels.
bool IsPlainName(const std::string& name);
// Returns INVALID_ARGUMENT unless IsPlainName(), for a field `policy`.
absl::Status CheckPolicyName(const std::string& name);

class PolicyFolder {
 public:
  // `signatures`: null if versions need none. `withhold`: see ReadForRobot().
  PolicyFolder(std::string directory, std::shared_ptr<const PolicySignatures> signatures,
               bool withhold)
      : directory_(std::move(directory)), signatures_(std::move(signatures)), withhold_(withhold) {}

  const std::string& directory() const { return directory_; }
  std::string PathOf(const PolicyVersion& version) const;  // of its policy file

  struct Listing {
    std::vector<PolicyVersion> versions;  // by policy, then version
    std::vector<absl::Status> refused;    // invalid names; messages start with the path
  };
  // Lists the policies and versions, without empty version folders; links that lead out of the
  // directory are refused. Returns NOT_FOUND if there is no such directory.
  absl::StatusOr<Listing> List() const;
  // Returns the versions of a policy that have a folder, also one without a file, ascending.
  std::vector<int64_t> VersionsOf(const std::string& policy) const;
  // Returns those that were pushed, ascending.
  std::vector<PolicyVersion> PushedVersions(const std::string& policy) const;
  bool IsPushed(const PolicyVersion& version) const;

  // Explains why nothing can be served and what to do: names the directory that was probably meant
  // if this one is one level too deep or too high, else the first of `refused`.
  std::string ExplainNone(const std::vector<absl::Status>& refused) const;

  // Identifies the state of a file. Two stamps differ if it was replaced or written in between.
  struct Stamp {
    int64_t modified_ns = 0;
    uint64_t inode = 0;
    int64_t size = -1;  // bytes; -1 if there is no file

    friend bool operator==(const Stamp&, const Stamp&) = default;
  };
  // Of a version's policy file and signature; of no file if versions need no signature.
  using Stamps = std::array<Stamp, 2>;
  Stamps StampsOf(const PolicyVersion& version) const;
  bool Has(const PolicyVersion& version) const { return StampsOf(version)[0].size >= 0; }

  // Reads the files of a version, not verified. Returns the errors of ReadVersionFiles().
  absl::StatusOr<VersionFiles> Read(const PolicyVersion& version) const;
  // As Read(), for the robots that play the version; PERMISSION_DENIED if files are withheld. The
  // files may have been replaced since the version was loaded.
  absl::StatusOr<VersionFiles> ReadForRobot(const PolicyVersion& version) const;

  struct Opened {
    std::string sha256;  // of the policy file
    std::shared_ptr<const Engine> engine;
  };
  // Reads and verifies a version, and makes one decision with it, so that all data that a decision
  // touches is in memory. Returns the errors of Read(), Verify() and ParsePolicyFile(), and
  // INVALID_ARGUMENT if the decision is not finite; messages start with the path.
  absl::StatusOr<Opened> Open(const PolicyVersion& version) const;

  // Returns INVALID_ARGUMENT unless the signature is that of a trusted key, or none is needed.
  absl::Status Verify(const PolicyVersion& version, const VersionFiles& files) const;
  // Returns INVALID_ARGUMENT unless the name is valid and the files can be served; the signature,
  // if versions need one, has to be that of the statement of their version.
  absl::Status CheckPushed(const PolicyVersion& version, const VersionFiles& files) const;

  // Returns FAILED_PRECONDITION if versions need a signature and this server cannot sign them.
  absl::Status CheckCanSign() const;
  // Returns the files of a version that this server makes, with a signature if versions need one.
  // INVALID_ARGUMENT if the policy is not valid, and the error of CheckCanSign().
  absl::StatusOr<VersionFiles> Format(const Policy& policy) const;

  // Writes a version to a hidden folder, flushes it to the disk and renames the folder. Returns the
  // error of the system, and leaves nothing behind, also if the version exists.
  absl::Status Write(const PolicyVersion& version, const VersionFiles& files) const;
  // Removes a version. Returns how many bytes its files had, or the error of the system.
  absl::StatusOr<int64_t> Remove(const PolicyVersion& version) const;
  // Removes what killed processes have left: the hidden folders of Write() that no process writes
  // to, temporary files of policies that are older than ten minutes, and empty version folders.
  // What cannot be removed stays.
  void Sweep() const;

 private:
  const std::string directory_;
  const std::shared_ptr<const PolicySignatures> signatures_;
  const bool withhold_;
};

}  // namespace spikeserve
