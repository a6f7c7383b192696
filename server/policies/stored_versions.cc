// How a PolicyRegistry adds and removes the versions that it stores itself: those that were
// promoted from a learned head, and those that were pushed.
#include <algorithm>
#include <limits>
#include <set>
#include <string>
#include <utility>

#include "absl/algorithm/container.h"
#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "server/base/log.h"
#include "server/policies/policy_registry.h"

namespace spikeserve {
namespace {

// How many removed versions of a policy are remembered, so that settings do not grow.
constexpr int64_t kRememberedRemovals = 256;

// Adds a removed version to the unloaded ones, and forgets the oldest removals of its policy.
void RememberRemoval(const PolicyFolder& folder, const PolicyVersion& removed,
                     std::set<PolicyVersion>* unloaded) {
  unloaded->insert(removed);
  int64_t remembered = 0;
  for (auto it = unloaded->end(); it != unloaded->begin();) {
    --it;
    if (it->policy != removed.policy || folder.Has(*it)) continue;
    if (++remembered > kRememberedRemovals) it = unloaded->erase(it);
  }
}

// Returns true if the policy has this version, or a former one had its number.
bool IsTaken(const PolicyFolder& folder, const Settings& settings, const PolicyVersion& version) {
  return folder.Has(version) || settings.promoted.contains(version) ||
         settings.unloaded.contains(version);
}

// Returns the number above every one for which IsTaken(), or the largest one, if that is taken.
int64_t NextNumber(const PolicyFolder& folder, const Settings& settings,
                   const std::string& policy) {
  const auto folders = folder.VersionsOf(policy);
  int64_t highest = folders.empty() ? 0 : folders.back();
  for (const auto& [version, ignored] : settings.promoted) {
    if (version.policy == policy) highest = std::max(highest, version.version);
  }
  for (const PolicyVersion& version : settings.unloaded) {
    if (version.policy == policy) highest = std::max(highest, version.version);
  }
  return highest == std::numeric_limits<int64_t>::max() ? highest : highest + 1;
}

}  // namespace

absl::StatusOr<PolicyVersion> PolicyRegistry::AddVersion(const NewVersion& added) {
  absl::StatusOr<PolicyVersion> version;
  RETURN_IF_ERROR(WithLatest([&] {
    settings_.mutex.AssertHeld();
    version = AddOnce(added);
    return version.status();
  }));
  return version;
}

absl::StatusOr<PolicyVersion> PolicyRegistry::AddOnce(const NewVersion& added) {
  PolicyVersion version = {.policy = added.policy, .version = added.version};
  if (version.version == 0) version.version = NextNumber(folder_, settings_.get(), added.policy);
  if (IsTaken(folder_, settings_.get(), version)) {
    return absl::AlreadyExistsError(absl::StrCat(
        "version: expected one that policy ", version.policy,
        " never had, or the file that it has, received another file of ", version.version,
        "; the next one is ", NextNumber(folder_, settings_.get(), version.policy)));
  }
  if (settings_.is_shared()) {
    RETURN_IF_ERROR(ShareOnce(added, version));
    return version;
  }
  RETURN_IF_ERROR(folder_.Write(version, added.files));
  if (auto loaded = LoadOnce(version, added.make_default, /*call=*/nullptr); !loaded.ok()) {
    folder_.Remove(version).status().IgnoreError();
    return loaded.status();
  }
  return version;
}

absl::Status PolicyRegistry::ShareOnce(const NewVersion& added, const PolicyVersion& version) {
  const std::string sha256 = Sha256Of(added.files.policy);
  const Settings before = settings_.get();
  Settings settings = before;
  settings.promoted[version] = sha256;
  if (added.make_default) {
    RETURN_IF_ERROR(ChooseDefault(version.version, &settings.policies[version.policy]));
  }
  RETURN_IF_ERROR(shared_.Put(version, added.files, sha256));
  auto status = settings_.Save(settings);
  bool is_undone = absl::IsAborted(status);  // after another error the store may have the settings
  if (status.ok()) {
    status = folder_.Write(version, added.files);
    // A server with the same folder may have been faster.
    if (status.ok() || folder_.Has(version)) {
      settings_.Replace(settings);
      status = Enact(before, /*call=*/nullptr);  // from here on as on every other server
    }
    if (status.ok()) status = catalog()->Find(version.policy, version.version).status();
    if (status.ok()) return status;
    Settings undone = before;
    RememberRemoval(folder_, version, &undone.unloaded);
    const auto saved = settings_.Save(undone);
    is_undone = saved.ok();
    if (!is_undone) LogError("a version that failed is not removed", {{"error", saved.message()}});
    // Where that is not undone, this server follows the store as every other one.
    const Settings failed = settings_.get();
    settings_.Replace(is_undone ? std::move(undone) : std::move(settings));
    Enact(failed, /*call=*/nullptr).IgnoreError();
  }
  // Another server that stores the same file of this number at this time finds it in the settings.
  if (added.files.pushed && is_undone) shared_.Remove(version, sha256, /*is_used=*/true);
  return status;
}

absl::StatusOr<int64_t> PolicyRegistry::RemoveStored(const PolicyVersion& version) {
  std::string sha256;
  bool is_used = false;
  RETURN_IF_ERROR(WithLatest([&] {
    settings_.mutex.AssertHeld();
    const auto stored = settings_.get().promoted.find(version);
    sha256 = stored == settings_.get().promoted.end() ? "" : stored->second;
    auto status = RemoveOnce(version);
    is_used = absl::c_any_of(settings_.get().promoted,
                             [&](const auto& left) { return left.second == sha256; });
    return status;
  }));
  shared_.Remove(version, sha256, is_used);
  auto removed = folder_.Remove(version);
  return absl::IsNotFound(removed.status()) ? 0 : std::move(removed);
}

absl::Status PolicyRegistry::RemoveOnce(const PolicyVersion& version) {
  const bool is_stored = settings_.get().promoted.contains(version) || folder_.IsPushed(version);
  if (!is_stored) {
    RETURN_IF_ERROR(catalog()->Find(version.policy, version.version).status());
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one that was pushed, received ", version.version,
                     ", whose file an operator has written; unload it, and remove the file"));
  }
  if (catalog()->Find(version.policy, version.version).ok()) RETURN_IF_ERROR(UnloadOnce(version));
  Settings settings = settings_.get();
  RETURN_IF_ERROR(
      CheckUnused(version.version, settings.policies[version.policy].DescribeUse(version.version)));
  settings.promoted.erase(version);
  RememberRemoval(folder_, version, &settings.unloaded);
  return settings_.Commit(std::move(settings));
}

}  // namespace spikeserve
