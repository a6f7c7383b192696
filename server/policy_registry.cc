#include "server/policy_registry.h"

#include <algorithm>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/ascii.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/engine/engine.h"
#include "core/model/json.h"
#include "core/model/policy_file.h"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;

// The folders in `directory` by name, hidden ones left out.
absl::StatusOr<std::vector<fs::path>> ListFolders(const fs::path& directory) {
  std::error_code error;
  std::vector<fs::path> folders;
  fs::directory_iterator it(directory, error);
  for (; !error && it != fs::directory_iterator(); it.increment(error)) {
    std::error_code ignored;  // a dangling link is no folder
    const bool hidden = it->path().filename().native().starts_with('.');
    if (!hidden && it->is_directory(ignored)) folders.push_back(it->path());
  }
  if (error) {
    return absl::NotFoundError(absl::StrCat(directory.string(), ": ", error.message()));
  }
  std::sort(folders.begin(), folders.end());
  return folders;
}

// Names become metric labels and proto strings, so they stay plain.
bool IsPolicyName(const std::string& name) {
  return std::all_of(name.begin(), name.end(), [](char c) {
    return absl::ascii_isalnum(c) || c == '.' || c == '-' || c == '_';
  });
}

// Decimal digits without a leading zero, so that no two folders are one version.
absl::StatusOr<int64_t> ParseVersion(const fs::path& folder) {
  const std::string name = folder.filename().string();
  int64_t version = 0;
  if (!absl::SimpleAtoi(name, &version) || version < 1 || absl::StrCat(version) != name) {
    return absl::InvalidArgumentError(
        absl::StrCat(folder.string(), ": expected a version, a positive integer, as its name"));
  }
  return version;
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadVersion(
    const fs::path& folder, const PolicyRegistry::NewObserver& new_observer) {
  const auto version = ParseVersion(folder);
  if (!version.ok()) return version.status();
  auto policy = ReadPolicyFile((folder / "policy.safetensors").string());
  if (!policy.ok()) return policy.status();

  auto served = std::make_shared<ServedPolicy>();
  served->name = folder.parent_path().filename().string();
  served->version = *version;
  served->observer = new_observer(served->name, served->version, *policy);
  const auto shared = std::make_shared<const Policy>(*std::move(policy));
  served->engine = MakeStreamingEngine(shared);
  served->fleet = std::make_shared<FleetHead>(shared);
  return served;
}

}  // namespace

absl::StatusOr<PolicyRegistry> PolicyRegistry::Load(const std::string& directory,
                                                    const NewObserver& new_observer,
                                                    std::vector<absl::Status>* refused) {
  const auto policy_folders = ListFolders(directory);
  if (!policy_folders.ok()) return policy_folders.status();

  PolicyRegistry registry;
  for (const fs::path& policy_folder : *policy_folders) {
    const std::string name = policy_folder.filename().string();
    if (!IsPolicyName(name)) {
      refused->push_back(absl::InvalidArgumentError(absl::StrCat(
          Quoted(policy_folder.string()), ": expected a name of letters, digits, '.', '-', '_'")));
      continue;
    }
    const auto version_folders = ListFolders(policy_folder);
    if (!version_folders.ok()) {
      refused->push_back(version_folders.status());
      continue;
    }
    for (const fs::path& folder : *version_folders) {
      auto served = LoadVersion(folder, new_observer);
      if (served.ok()) {
        registry.policies_[name].emplace((*served)->version, *std::move(served));
      } else {
        refused->push_back(served.status());
      }
    }
  }
  return registry;
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyRegistry::Find(const std::string& name,
                                                                         int64_t version) const {
  const auto policy = policies_.find(name);
  if (policy == policies_.end()) {
    const std::string names = absl::StrJoin(
        policies_, ", ", [](std::string* out, const auto& item) { *out += item.first; });
    return absl::NotFoundError(
        absl::StrCat("policy: expected one of [", names, "], received ", Quoted(name)));
  }
  if (version == 0) return policy->second.rbegin()->second;
  const auto found = policy->second.find(version);
  if (found == policy->second.end()) {
    const std::string versions =
        absl::StrJoin(policy->second, ", ",
                      [](std::string* out, const auto& item) { absl::StrAppend(out, item.first); });
    return absl::NotFoundError(absl::StrCat("version: expected 0 or one of [", versions,
                                            "] of policy ", name, ", received ", version));
  }
  return found->second;
}

int64_t PolicyRegistry::DefaultVersion(const std::string& name) const {
  return policies_.at(name).rbegin()->first;
}

std::vector<std::shared_ptr<const ServedPolicy>> PolicyRegistry::List() const {
  std::vector<std::shared_ptr<const ServedPolicy>> list;
  for (const auto& [name, versions] : policies_) {
    for (const auto& [version, served] : versions) list.push_back(served);
  }
  return list;
}

}  // namespace spikeserve
