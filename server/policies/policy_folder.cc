#include "server/policies/policy_folder.h"

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
#include "absl/strings/strip.h"
#include "core/action/action_head.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "core/engine/factory/engine_factory.h"
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

PolicyFolder::Stamp StampOf(const std::string& path) {
  struct stat file = {};
  if (stat(path.c_str(), &file) != 0) return {};
  return {.modified_ns = int64_t{file.st_mtim.tv_sec} * 1'000'000'000 + file.st_mtim.tv_nsec,
          .inode = file.st_ino,
          .size = file.st_size};
}

// Parses a policy and makes one decision with it.
absl::StatusOr<std::shared_ptr<const Engine>> TryPolicy(absl::string_view file) {
  ASSIGN_OR_RETURN(auto policy, ParsePolicyFile(file));
  std::shared_ptr<const Engine> engine = MakeEngine(std::move(policy));
  RETURN_IF_ERROR(WarmUp(*engine));
  return engine;
}

}  // namespace

std::string PolicyFolder::ExplainNone(const std::vector<absl::Status>& refused) const {
  const fs::path path = fs::absolute(directory_).lexically_normal();
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
  return absl::StrCat(directory_, ": expected <policy>/<version>/", kFileName,
                      ", received no version that can be served: ", reason,
                      ". To start without a policy, use --allow_no_policies");
}

bool IsPlainName(const std::string& name) {
  if (name.empty() || name.size() > kLongestName || name.front() == '.') return false;
  return std::all_of(name.begin(), name.end(), [](char c) {
    return absl::ascii_isalnum(c) || c == '.' || c == '-' || c == '_';
  });
}

absl::Status CheckPolicyName(const std::string& name) {
  if (IsPlainName(name)) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("policy: expected a name of at most ", kLongestName,
                   " letters, digits, '.', '-', '_', received ", Quoted(name)));
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

absl::StatusOr<PolicyFolder::Listing> PolicyFolder::List() const {
  ASSIGN_OR_RETURN(const auto policies, ListFolders(directory_));
  Listing found;
  for (const fs::path& folder : policies) {
    const std::string name = folder.filename().string();
    if (!IsPlainName(name)) {
      found.refused.push_back(absl::InvalidArgumentError(absl::StrCat(
          Quoted(folder.string()), ": expected a name of letters, digits, '.', '-', '_'")));
      continue;
    }
    // The names of what lies elsewhere are not shown either.
    if (auto status = CheckWithin(directory_, folder); !status.ok()) {
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
      if (auto status = CheckWithin(directory_, version_folder); !status.ok()) {
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

std::string PolicyFolder::PathOf(const PolicyVersion& version) const {
  return (fs::path(directory_) / version.policy / absl::StrCat(version.version) / kFileName)
      .string();
}

PolicyFolder::Stamps PolicyFolder::StampsOf(const PolicyVersion& version) const {
  const std::string path = PathOf(version);
  return {StampOf(path), signatures_ == nullptr ? Stamp() : StampOf(SignaturePath(path))};
}

absl::StatusOr<VersionFiles> PolicyFolder::Read(const PolicyVersion& version) const {
  return ReadVersionFiles(PathOf(version), /*with_signature=*/true);
}

absl::StatusOr<VersionFiles> PolicyFolder::ReadForRobot(const PolicyVersion& version) const {
  if (!withhold_) return Read(version);
  return absl::PermissionDeniedError("policy: files are withheld (--withhold_policies)");
}

absl::StatusOr<PolicyFolder::Opened> PolicyFolder::Open(const PolicyVersion& version) const {
  const std::string path = PathOf(version);
  for (const std::string& file : {path, SignaturePath(path)}) {
    RETURN_IF_ERROR(CheckWithin(directory_, file));
  }
  // The bytes that are verified are those that are parsed: the file may change at any time.
  ASSIGN_OR_RETURN(const auto files, ReadVersionFiles(path, signatures_ != nullptr));
  if (auto status = Verify(version, files); !status.ok()) return Annotate(status, path);
  auto engine = TryPolicy(files.policy);
  if (!engine.ok()) return Annotate(engine.status(), path);
  return Opened{.sha256 = Sha256Of(files.policy), .engine = *std::move(engine)};
}

absl::Status PolicyFolder::Verify(const PolicyVersion& version, const VersionFiles& files) const {
  if (signatures_ == nullptr) return absl::OkStatus();
  return signatures_->Verify(files.signature, {.policy = version.policy,
                                               .version = version.version,
                                               .sha256 = Sha256Of(files.policy),
                                               .content = files.policy});
}

absl::Status PolicyFolder::CheckPushed(const PolicyVersion& version,
                                       const VersionFiles& files) const {
  RETURN_IF_ERROR(CheckPolicyName(version.policy));
  if (signatures_ != nullptr) {
    const SignedVersion named = {version.policy, version.version, Sha256Of(files.policy)};
    if (auto status = signatures_->Verify(files.signature, named); !status.ok()) {
      return Annotate(status, absl::StrCat("signature of \"",
                                           absl::StripSuffix(StatementOf(named), "\n"), "\""));
    }
  }
  return Annotate(TryPolicy(files.policy).status(), "data");
}

absl::Status PolicyFolder::CheckCanSign() const {
  return signatures_ == nullptr ? absl::OkStatus() : signatures_->CheckCanSign();
}

absl::StatusOr<VersionFiles> PolicyFolder::Format(const Policy& policy) const {
  ASSIGN_OR_RETURN(auto bytes, FormatPolicyFile(policy));
  VersionFiles files = {.policy = std::move(bytes), .signature = {}};
  if (signatures_ == nullptr) return files;
  ASSIGN_OR_RETURN(files.signature, signatures_->Sign(files.policy));
  return files;
}

}  // namespace spikeserve
