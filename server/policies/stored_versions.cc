// How a PolicyRegistry adds and removes the versions that it stores itself: those that were
// promoted from a learned head, and those that were pushed. Servers that share settings keep their
// files in the store, too: of a promoted version under its SHA-256, with its signature beside it;
// of a pushed version, whose signature is for its name and number, as one file under all three.
#include <algorithm>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/algorithm/container.h"
#include "absl/status/status.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "server/base/log.h"
#include "server/policies/policy_registry.h"
#include "server/policies/policy_settings.h"
#include "server/policies/version_writer.h"

namespace spikeserve {
namespace {

// How many removed versions of a policy are remembered, so that settings do not grow.
constexpr int64_t kRememberedRemovals = 256;

absl::Status CheckSha256(absl::string_view bytes, absl::string_view expected) {
  const std::string received = Sha256Of(bytes);
  if (received == expected) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("expected SHA-256 ", expected, ", received ", received));
}

// The name of the shared file of a pushed version, which holds the length of the signature in
// decimal, a space, the signature, and the policy file.
std::string PushedName(const PolicyVersion& version, const std::string& sha256) {
  return absl::StrCat(sha256, ".", version.policy, ".", version.version);
}

absl::StatusOr<VersionFiles> ParsePushed(absl::string_view bytes) {
  const std::pair<absl::string_view, absl::string_view> parts =
      absl::StrSplit(bytes, absl::MaxSplits(' ', 1));
  size_t length = 0;
  if (!absl::SimpleAtoi(parts.first, &length) || length > parts.second.size()) {
    return absl::InvalidArgumentError("expected a signature and a policy, received other bytes");
  }
  return VersionFiles{.policy = std::string(parts.second.substr(length)),
                      .signature = std::string(parts.second.substr(0, length)),
                      .pushed = true};
}

// Adds a removed version to the unloaded ones, and forgets the oldest removals of its policy.
void RememberRemoval(const std::string& directory, const PolicyVersion& removed,
                     std::set<PolicyVersion>* unloaded) {
  unloaded->insert(removed);
  int64_t remembered = 0;
  for (auto it = unloaded->end(); it != unloaded->begin();) {
    --it;
    if (it->policy != removed.policy || StampOf(PolicyFilePath(directory, *it)).size >= 0) continue;
    if (++remembered > kRememberedRemovals) it = unloaded->erase(it);
  }
}

}  // namespace

void PolicyRegistry::FetchStored(const Settings& before) {
  const auto catalog = this->catalog();
  for (const auto& [version, sha256] : settings_.promoted) {
    if (const auto served = catalog->Find(version.policy, version.version);
        served.ok() && (*served)->sha256 == sha256) {
      continue;
    }
    const std::string path = PolicyFilePath(options_.directory, version);
    absl::Status status;
    if (StampOf(path).size >= 0) {
      const auto found = ReadFile(path);
      if (found.ok()) status = Annotate(CheckSha256(*found, sha256), path);
    } else {
      const auto files = FetchFiles(version, sha256);
      status = Annotate(files.status(), path);
      if (status.ok()) status = WriteVersion(options_.directory, version, *files);
    }
    if (!status.ok()) {
      LogError("promoted version not taken over",
               {{"policy", version.policy}, {"error", status.message()}});
    }
  }
  for (const auto& [version, ignored] : before.promoted) {
    if (settings_.promoted.contains(version) || !settings_.unloaded.contains(version)) continue;
    RemoveVersion(options_.directory, version).status().IgnoreError();  // it is not served
  }
}

absl::StatusOr<VersionFiles> PolicyRegistry::FetchFiles(const PolicyVersion& version,
                                                        const std::string& sha256) {
  VersionFiles files;
  if (auto pushed = options_.shared->GetFile(PushedName(version, sha256)); pushed.ok()) {
    ASSIGN_OR_RETURN(files, ParsePushed(*pushed));
  } else if (!absl::IsNotFound(pushed.status())) {
    return pushed.status();
  } else {
    ASSIGN_OR_RETURN(files.policy, options_.shared->GetFile(sha256));
    auto signature = options_.shared->GetFile(SignaturePath(sha256));
    if (!signature.ok() && !absl::IsNotFound(signature.status())) return signature.status();
    files.signature = std::move(signature).value_or("");
  }
  RETURN_IF_ERROR(CheckSha256(files.policy, sha256));
  if (options_.signatures == nullptr) return files;
  auto status = options_.signatures->Verify(
      files.signature, {version.policy, version.version, sha256, files.policy});
  if (!status.ok()) return Annotate(status, "promoted version in the session store");
  return files;
}

absl::Status PolicyRegistry::PutFiles(const PolicyVersion& version, const VersionFiles& files,
                                      const std::string& sha256) {
  if (files.pushed) {
    return options_.shared->PutFile(
        PushedName(version, sha256),
        absl::StrCat(files.signature.size(), " ", files.signature, files.policy));
  }
  if (!files.signature.empty()) {
    RETURN_IF_ERROR(options_.shared->PutFile(SignaturePath(sha256), files.signature));
  }
  return options_.shared->PutFile(sha256, files.policy);
}

bool PolicyRegistry::IsTaken(const PolicyVersion& version) const {
  return StampOf(PolicyFilePath(options_.directory, version)).size >= 0 ||
         settings_.promoted.contains(version) || settings_.unloaded.contains(version);
}

int64_t PolicyRegistry::NextNumber(const std::string& policy) const {
  const auto folders = VersionsOf(options_.directory, policy);
  int64_t highest = folders.empty() ? 0 : folders.back();
  for (const auto& [version, ignored] : settings_.promoted) {
    if (version.policy == policy) highest = std::max(highest, version.version);
  }
  for (const PolicyVersion& version : settings_.unloaded) {
    if (version.policy == policy) highest = std::max(highest, version.version);
  }
  return highest + 1;
}

absl::Status PolicyRegistry::CheckPushed(const NewVersion& added) const {
  if (!IsPlainName(added.policy)) {
    return absl::InvalidArgumentError(
        absl::StrCat("policy: expected a name of at most ", kLongestName,
                     " letters, digits, '.', '-', '_', received ", Quoted(added.policy)));
  }
  const PolicyVersion version = {.policy = added.policy, .version = added.version};
  if (options_.signatures != nullptr) {
    const SignedVersion named = {version.policy, version.version, Sha256Of(added.files.policy)};
    if (auto status = options_.signatures->Verify(added.files.signature, named); !status.ok()) {
      return Annotate(status, absl::StrCat("signature of \"",
                                           absl::StripSuffix(StatementOf(named), "\n"), "\""));
    }
  }
  return Annotate(TryVersion(version, added.files, /*signatures=*/nullptr).status(), "data");
}

absl::StatusOr<PolicyVersion> PolicyRegistry::AddVersion(const NewVersion& added) {
  absl::StatusOr<PolicyVersion> version;
  RETURN_IF_ERROR(WithLatest([&] {
    change_mutex_.AssertHeld();
    version = AddOnce(added);
    return version.status();
  }));
  return version;
}

absl::StatusOr<PolicyVersion> PolicyRegistry::AddOnce(const NewVersion& added) {
  PolicyVersion version = {.policy = added.policy, .version = added.version};
  if (version.version == 0) version.version = NextNumber(added.policy);
  if (IsTaken(version)) {
    return absl::AlreadyExistsError(
        absl::StrCat("version: expected one that policy ", version.policy,
                     " never had, or the file that it has, received another file of ",
                     version.version, "; the next one is ", NextNumber(version.policy)));
  }
  if (shares_settings()) {
    RETURN_IF_ERROR(ShareOnce(added, version));
    return version;
  }
  RETURN_IF_ERROR(WriteVersion(options_.directory, version, added.files));
  if (auto loaded = LoadOnce(version, added.make_default); !loaded.ok()) {
    RemoveVersion(options_.directory, version).status().IgnoreError();
    return loaded.status();
  }
  return version;
}

absl::Status PolicyRegistry::ShareOnce(const NewVersion& added, const PolicyVersion& version) {
  const std::string sha256 = Sha256Of(added.files.policy);
  const Settings before = settings_;
  Settings settings = settings_;
  settings.promoted[version] = sha256;
  if (added.make_default) {
    PolicySettings& changed = settings.policies[version.policy];
    RETURN_IF_ERROR(CheckNoRollout(changed));
    changed.default_version = version.version;
    changed.default_follows_highest = false;
  }
  RETURN_IF_ERROR(PutFiles(version, added.files, sha256));
  auto status = Save(settings);
  if (status.ok()) {
    status = WriteVersion(options_.directory, version, added.files);
    // From here on as on every other server.
    if (status.ok()) status = Adopt({.revision = revision_, .json = ToJson(settings)});
    if (status.ok()) status = catalog()->Find(version.policy, version.version).status();
    if (status.ok()) return status;
    settings = before;
    RememberRemoval(options_.directory, version, &settings.unloaded);
    if (auto undone = Save(settings); !undone.ok()) {
      LogError("a version that failed is not removed", {{"error", undone.message()}});
    }
    Adopt({.revision = revision_, .json = ToJson(settings)}).IgnoreError();
  }
  // Another server that stores the same file of this number at this time finds it in the settings.
  if (added.files.pushed) options_.shared->RemoveFile(PushedName(version, sha256)).IgnoreError();
  return status;
}

std::vector<PolicyVersion> PolicyRegistry::PushedVersions(const std::string& policy) const {
  std::vector<PolicyVersion> pushed;
  for (const int64_t number : VersionsOf(options_.directory, policy)) {
    const PolicyVersion version = {.policy = policy, .version = number};
    if (IsPushed(options_.directory, version)) pushed.push_back(version);
  }
  return pushed;
}

absl::StatusOr<int64_t> PolicyRegistry::RemoveStored(const PolicyVersion& version) {
  std::string sha256;
  bool is_used = false;
  RETURN_IF_ERROR(WithLatest([&] {
    change_mutex_.AssertHeld();
    const auto stored = settings_.promoted.find(version);
    sha256 = stored == settings_.promoted.end() ? "" : stored->second;
    auto status = RemoveOnce(version);
    is_used =
        absl::c_any_of(settings_.promoted, [&](const auto& left) { return left.second == sha256; });
    return status;
  }));
  if (!sha256.empty()) {
    options_.shared->RemoveFile(PushedName(version, sha256)).IgnoreError();
    if (!is_used) {
      options_.shared->RemoveFile(sha256).IgnoreError();
      options_.shared->RemoveFile(SignaturePath(sha256)).IgnoreError();
    }
  }
  auto removed = RemoveVersion(options_.directory, version);
  return absl::IsNotFound(removed.status()) ? 0 : std::move(removed);
}

absl::Status PolicyRegistry::RemoveOnce(const PolicyVersion& version) {
  const bool is_stored =
      settings_.promoted.contains(version) || IsPushed(options_.directory, version);
  if (!is_stored) {
    RETURN_IF_ERROR(catalog()->Find(version.policy, version.version).status());
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one that was pushed, received ", version.version,
                     ", whose file an operator has written; unload it, and remove the file"));
  }
  if (catalog()->Find(version.policy, version.version).ok()) RETURN_IF_ERROR(UnloadOnce(version));
  Settings settings = settings_;
  const std::string use = settings.policies[version.policy].DescribeUse(version.version);
  if (!use.empty()) {
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one that no setting uses, received ", version.version,
                     ", which is ", use));
  }
  settings.promoted.erase(version);
  RememberRemoval(options_.directory, version, &settings.unloaded);
  return Commit(std::move(settings));
}

}  // namespace spikeserve
