#include "server/policies/policy_repository.h"

#include <sys/stat.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/algorithm/container.h"
#include "absl/functional/function_ref.h"
#include "absl/strings/ascii.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "core/engine/factory/engine_factory.h"
#include "core/learning/fleet_head.h"
#include "core/model/policy_file.h"
#include "server/policies/confined_path.h"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;

// Returns the folders in `directory`, sorted by name, without hidden ones.
absl::StatusOr<std::vector<fs::path>> ListFolders(const fs::path& directory) {
  std::error_code error;
  std::vector<fs::path> folders;
  fs::directory_iterator it(directory, error);
  for (; !error && it != fs::directory_iterator(); it.increment(error)) {
    std::error_code ignored;  // is_directory fails for a dangling link, which is skipped
    const bool hidden = it->path().filename().native().starts_with('.');
    if (!hidden && it->is_directory(ignored)) folders.push_back(it->path());
  }
  if (error) {
    return absl::NotFoundError(absl::StrCat(directory.string(), ": ", error.message()));
  }
  std::sort(folders.begin(), folders.end());
  return folders;
}

// Makes one decision, so that all data that a decision touches is in memory before the first
// request. Returns INVALID_ARGUMENT if the result is not finite.
absl::Status WarmUp(const Engine& engine) {
  const Policy& policy = engine.policy();
  const std::vector<float> observation(static_cast<size_t>(policy.observation_size()), 0.0f);
  Engine::Output output;
  engine.Decide(*engine.NewContext(), policy.target_return, observation, &output);
  const ActionChoice choice = ChooseAction(policy.weights.head, policy.action_space, output.readout,
                                           /*selection=*/{}, /*random=*/0);
  const auto is_finite = [](float value) { return std::isfinite(value); };
  if (absl::c_all_of(output.readout, is_finite) && absl::c_all_of(choice.logits, is_finite)) {
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError("expected a finite first decision, received NaN or infinity");
}

constexpr char kFileName[] = "policy.safetensors";

bool HasPolicyFile(const fs::path& directory) {
  std::error_code error;
  return fs::exists(directory / kFileName, error);
}

// Returns the first folder of `directory` for which `condition` holds, or an empty path.
fs::path FirstFolder(const fs::path& directory,
                     absl::FunctionRef<bool(const fs::path& folder)> condition) {
  const auto folders = ListFolders(directory);
  if (!folders.ok()) return {};
  const auto found = std::find_if(folders->begin(), folders->end(), condition);
  return found == folders->end() ? fs::path() : *found;
}

// Returns true if `directory` has the folders of versions, such as 1/policy.safetensors.
bool HasVersions(const fs::path& directory) {
  return !FirstFolder(directory, HasPolicyFile).empty();
}

bool HasPolicies(const fs::path& directory) { return !FirstFolder(directory, HasVersions).empty(); }

std::string UseInstead(absl::string_view what, const fs::path& meant) {
  return absl::StrCat("this is ", what, "; use --policies=", meant.string());
}

}  // namespace

std::string ExplainNoPolicies(const std::string& directory,
                              const std::vector<absl::Status>& refused) {
  const fs::path path = fs::absolute(directory).lexically_normal();
  // A path that ends with a slash has an empty last element.
  const fs::path folder = path.has_filename() ? path : path.parent_path();
  std::string reason = "the directory has no policies; copy or train one (docs/guides/policies.md)";
  if (HasPolicyFile(folder)) {
    reason = UseInstead("the folder of one version", folder.parent_path().parent_path());
  } else if (HasVersions(folder)) {
    reason = UseInstead("the folder of one policy", folder.parent_path());
  } else if (const fs::path below = FirstFolder(folder, HasPolicies); !below.empty()) {
    reason = UseInstead("a directory above the policies", below);
  } else if (!refused.empty()) {
    reason = std::string(refused.front().message());
  }
  return absl::StrCat(directory, ": expected <policy>/<version>/", kFileName,
                      ", received no version that can be served: ", reason,
                      ". To start without a policy, use --allow_no_policies");
}

FileStamp StampOf(const std::string& path) {
  struct stat file = {};
  if (stat(path.c_str(), &file) != 0) return {};
  return {.modified_ns = int64_t{file.st_mtim.tv_sec} * 1'000'000'000 + file.st_mtim.tv_nsec,
          .inode = file.st_ino,
          .size = file.st_size};
}

bool IsPlainName(const std::string& name) {
  if (name.empty() || name.size() > kLongestName || name.front() == '.') return false;
  return std::all_of(name.begin(), name.end(), [](char c) {
    return absl::ascii_isalnum(c) || c == '.' || c == '-' || c == '_';
  });
}

absl::StatusOr<int64_t> ParseVersion(const fs::path& folder) {
  const std::string name = folder.filename().string();
  int64_t version = 0;
  if (!absl::SimpleAtoi(name, &version) || version < 1 || absl::StrCat(version) != name) {
    return absl::InvalidArgumentError(
        absl::StrCat(folder.string(), ": expected a version, a positive integer, as its name"));
  }
  return version;
}

absl::StatusOr<PolicyFolders> ListPolicyFolders(const std::string& directory) {
  ASSIGN_OR_RETURN(const auto policies, ListFolders(directory));
  PolicyFolders found;
  for (const fs::path& folder : policies) {
    const std::string name = folder.filename().string();
    if (!IsPlainName(name)) {
      found.refused.push_back(absl::InvalidArgumentError(absl::StrCat(
          Quoted(folder.string()), ": expected a name of letters, digits, '.', '-', '_'")));
      continue;
    }
    // The names of what lies elsewhere are not shown either.
    if (auto status = CheckWithin(directory, folder); !status.ok()) {
      found.refused.push_back(std::move(status));
      continue;
    }
    const auto versions = ListFolders(folder);
    if (!versions.ok()) {
      found.refused.push_back(versions.status());
      continue;
    }
    for (const fs::path& version_folder : *versions) {
      const auto version = ParseVersion(version_folder);
      if (auto status = CheckWithin(directory, version_folder); !status.ok()) {
        found.refused.push_back(std::move(status));
        continue;
      }
      std::error_code ignored;
      if (version.ok() && fs::is_empty(version_folder, ignored)) continue;
      if (version.ok()) {
        found.versions.push_back({.policy = name, .version = *version});
      } else {
        found.refused.push_back(version.status());
      }
    }
  }
  std::sort(found.versions.begin(), found.versions.end());
  return found;
}

std::string PolicyFilePath(const std::string& directory, const PolicyVersion& version) {
  return (fs::path(directory) / version.policy / absl::StrCat(version.version) / kFileName)
      .string();
}

absl::StatusOr<std::shared_ptr<const Engine>> TryVersion(const PolicyVersion& version,
                                                         const VersionFiles& files,
                                                         const PolicySignatures* signatures) {
  if (signatures != nullptr) {
    RETURN_IF_ERROR(signatures->Verify(files.signature, {.policy = version.policy,
                                                         .version = version.version,
                                                         .sha256 = Sha256Of(files.policy),
                                                         .content = files.policy}));
  }
  ASSIGN_OR_RETURN(auto policy, ParsePolicyFile(files.policy));
  std::shared_ptr<const Engine> engine = MakeEngine(std::move(policy));
  RETURN_IF_ERROR(WarmUp(*engine));
  return engine;
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadPolicyVersion(
    const std::string& directory, const PolicyVersion& version, const PolicySignatures* signatures,
    std::shared_ptr<LearningSwitch> learning, const NewObserver& new_observer, bool share_heads,
    const OpenHeadLog& open_log) {
  const std::string path = PolicyFilePath(directory, version);
  for (const std::string& file : {path, SignaturePath(path)}) {
    RETURN_IF_ERROR(CheckWithin(directory, file));
  }
  // The bytes that are verified are those that are parsed: the file may change at any time.
  ASSIGN_OR_RETURN(const auto files, ReadVersionFiles(path, signatures != nullptr));
  auto engine = TryVersion(version, files, signatures);
  if (!engine.ok()) return Annotate(engine.status(), path);
  auto served = std::make_shared<ServedPolicy>();
  served->name = version.policy;
  served->version = version.version;
  served->sha256 = Sha256Of(files.policy);
  served->engine = *std::move(engine);
  const std::shared_ptr<const Policy> shared(served->engine, &served->policy());
  served->learning = std::move(learning);
  if (open_log != nullptr) served->log = open_log(*served);
  served->heads =
      served->log != nullptr ? served->log->heads() : std::make_shared<TenantHeads>(shared);
  served->share_heads = share_heads;
  served->heads->Of("");  // exists before a session learns it
  served->observer = new_observer(served->name, served->version, served->policy());
  return served;
}

}  // namespace spikeserve
