#include "server/policies/policy_registry.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

// Returns NOT_FOUND unless the policy has this version.
absl::Status CheckVersion(const CatalogPolicy& policy, const std::string& name, int64_t version) {
  if (policy.versions.contains(version)) return absl::OkStatus();
  return absl::NotFoundError(
      absl::StrCat("version: expected a served version of policy ", name, ", received ", version));
}

// Returns FAILED_PRECONDITION unless the shadow has the spaces of every version that sessions can
// be routed to without naming a version.
absl::Status CheckShadow(const CatalogPolicy& policy, const std::string& name,
                         std::vector<TrafficShare> shadowed, int64_t shadow_version) {
  if (shadow_version == 0) return absl::OkStatus();
  if (auto status = CheckVersion(policy, name, shadow_version); !status.ok()) return status;
  if (shadowed.empty()) shadowed = {{.version = policy.DefaultVersion(), .percent = 100}};
  for (const TrafficShare& share : shadowed) {
    if (SameSpaces(*policy.versions.at(share.version), *policy.versions.at(shadow_version))) {
      continue;
    }
    return absl::FailedPreconditionError(
        absl::StrCat("shadow_version: expected the observations and actions of version ",
                     share.version, ", received version ", shadow_version));
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::unique_ptr<PolicyRegistry>> PolicyRegistry::Load(
    const std::string& directory, const std::string& settings_path, NewObserver new_observer,
    ReloadReport* report) {
  auto registry = std::unique_ptr<PolicyRegistry>(
      new PolicyRegistry(directory, settings_path, std::move(new_observer)));
  if (!settings_path.empty()) {
    auto settings = ReadSettings(settings_path);
    if (!settings.ok()) return Annotate(settings.status(), "--policy_settings");
    absl::MutexLock change(&registry->change_mutex_);
    registry->settings_ = *std::move(settings);
    // A file that cannot be written would refuse the first change of an operator.
    if (auto status = registry->Save(registry->settings_); !status.ok()) {
      return Annotate(
          status, "--policy_settings: expected a file in a directory that the server can write");
    }
  }
  auto loaded = registry->Reload();
  if (!loaded.ok()) return Annotate(loaded.status(), "--policies");
  *report = *std::move(loaded);
  return registry;
}

std::vector<std::string> PolicyRegistry::ApplySettings(PolicyCatalog* catalog) const {
  std::vector<std::string> waiting;
  for (const auto& [name, settings] : settings_.policies) {
    const auto policy = catalog->policies().find(name);
    std::set<int64_t> versions;
    if (policy != catalog->policies().end()) {
      for (const auto& [version, served] : policy->second.versions) versions.insert(version);
    }
    std::vector<std::string> lines;
    PolicySettings effective = EffectiveSettings(settings, versions, &lines);
    for (const std::string& line : lines) {
      waiting.push_back(absl::StrCat(settings_path_, ": policies.", name, ".", line));
    }
    if (!versions.empty()) policy->second.settings = std::move(effective);
  }
  return waiting;
}

bool PolicyRegistry::HasUnloaded() {
  absl::MutexLock change(&change_mutex_);
  return !settings_.unloaded.empty();
}

absl::Status PolicyRegistry::Save(const Settings& settings) const {
  return settings_path_.empty() ? absl::OkStatus() : WriteSettings(settings, settings_path_);
}

std::shared_ptr<const PolicyCatalog> PolicyRegistry::catalog() const {
  absl::MutexLock lock(&mutex_);
  return catalog_;
}

void PolicyRegistry::Publish(PolicyCatalog catalog) {
  std::shared_ptr<const PolicyCatalog> next =
      std::make_shared<const PolicyCatalog>(std::move(catalog));
  absl::MutexLock lock(&mutex_);
  catalog_.swap(next);
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyRegistry::Read(
    const PolicyVersion& version) {
  // The stamp is taken before reading, so that a file that changes while it is read is read again.
  KnownFile& file = files_[version];
  file.stamp = StampOf(PolicyFilePath(directory_, version));
  std::shared_ptr<LearningSwitch>& learning = learning_[version.policy];
  if (learning == nullptr) {
    learning = std::make_shared<LearningSwitch>();
    const auto set = settings_.policies.find(version.policy);
    learning->set_paused(set != settings_.policies.end() && set->second.learning_paused);
  }
  auto served = LoadPolicyVersion(directory_, version, learning, new_observer_);
  file.status = served.status();
  return served;
}

absl::StatusOr<ReloadReport> PolicyRegistry::Reload() {
  absl::MutexLock change(&change_mutex_);
  auto folders = ListPolicyFolders(directory_);
  if (!folders.ok()) return folders.status();
  ReloadReport report;
  report.refused = std::move(folders->refused);
  PolicyCatalog catalog = *this->catalog();
  LoadChanged(folders->versions, &catalog, &report);
  UnloadRemoved(&catalog, &report);
  report.waiting = ApplySettings(&catalog);
  if (!report.loaded.empty() || !report.unloaded.empty()) Publish(std::move(catalog));
  return report;
}

void PolicyRegistry::LoadChanged(const std::vector<PolicyVersion>& versions, PolicyCatalog* catalog,
                                 ReloadReport* report) {
  std::map<PolicyVersion, KnownFile> still_there;
  for (const PolicyVersion& version : versions) {
    if (settings_.unloaded.contains(version)) continue;
    const auto known = files_.find(version);
    const FileStamp stamp = StampOf(PolicyFilePath(directory_, version));
    if (known == files_.end() || known->second.stamp != stamp) {
      if (auto served = Read(version); served.ok()) {
        catalog->policies()[version.policy].versions[version.version] = *std::move(served);
        report->loaded.push_back(version);
      }
    }
    still_there.emplace(version, files_[version]);
    const absl::Status& status = files_[version].status;
    if (!status.ok()) report->refused.push_back(status);
  }
  files_ = std::move(still_there);
}

void PolicyRegistry::UnloadRemoved(PolicyCatalog* catalog, ReloadReport* report) {
  for (auto policy = catalog->policies().begin(); policy != catalog->policies().end();) {
    auto& versions = policy->second.versions;
    for (auto it = versions.begin(); it != versions.end();) {
      const PolicyVersion version = {.policy = policy->first, .version = it->first};
      const std::string path = PolicyFilePath(directory_, version);
      const std::string use = policy->second.settings.DescribeUse(version.version);
      const bool gone = StampOf(path).size < 0;
      if (gone && !use.empty()) {
        report->refused.push_back(absl::FailedPreconditionError(
            absl::StrCat(path, ": the file is gone; the version is served because it is ", use)));
      }
      if (gone && use.empty()) {
        report->unloaded.push_back(version);
        it = versions.erase(it);
      } else {
        ++it;
      }
    }
    policy = versions.empty() ? catalog->policies().erase(policy) : std::next(policy);
  }
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyRegistry::LoadVersion(
    const PolicyVersion& version) {
  if (!IsPlainName(version.policy)) {
    return absl::InvalidArgumentError(
        absl::StrCat("policy: expected a name of letters, digits, '.', '-', '_', received ",
                     Quoted(version.policy)));
  }
  if (version.version < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("version: expected at least 1, received ", version.version));
  }
  absl::MutexLock change(&change_mutex_);
  auto served = Read(version);
  if (!served.ok()) return served.status();
  Settings settings = settings_;
  if (settings.unloaded.erase(version) == 1) {
    if (auto status = Save(settings); !status.ok()) return status;
    settings_ = std::move(settings);
  }
  PolicyCatalog catalog = *this->catalog();
  catalog.policies()[version.policy].versions[version.version] = *served;
  ApplySettings(&catalog);
  Publish(std::move(catalog));
  return served;
}

absl::Status PolicyRegistry::Unload(const PolicyVersion& version) {
  absl::MutexLock change(&change_mutex_);
  PolicyCatalog catalog = *this->catalog();
  const auto found = catalog.FindPolicy(version.policy);
  if (!found.ok()) return found.status();
  CatalogPolicy& policy = catalog.policies()[version.policy];
  if (auto status = CheckVersion(policy, version.policy, version.version); !status.ok()) {
    return status;
  }
  if (const std::string use = policy.settings.DescribeUse(version.version); !use.empty()) {
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one that no setting uses, received ", version.version,
                     ", which is ", use));
  }
  Settings settings = settings_;
  settings.unloaded.insert(version);
  if (auto status = Save(settings); !status.ok()) return status;
  settings_ = std::move(settings);
  policy.versions.erase(version.version);
  if (policy.versions.empty()) catalog.policies().erase(version.policy);
  files_.erase(version);
  Publish(std::move(catalog));
  return absl::OkStatus();
}

absl::Status PolicyRegistry::Change(
    const std::string& policy,
    absl::FunctionRef<absl::Status(const CatalogPolicy& policy, PolicySettings* settings)> change) {
  absl::MutexLock lock(&change_mutex_);
  PolicyCatalog catalog = *this->catalog();
  const auto found = catalog.FindPolicy(policy);
  if (!found.ok()) return found.status();
  Settings settings = settings_;
  if (auto status = change(**found, &settings.policies[policy]); !status.ok()) return status;
  if (auto status = Save(settings); !status.ok()) return status;
  settings_ = std::move(settings);
  ApplySettings(&catalog);
  Publish(std::move(catalog));
  return absl::OkStatus();
}

absl::StatusOr<int64_t> PolicyRegistry::SetDefault(const std::string& policy, int64_t version) {
  int64_t result = version;
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    if (version == 0) {
      result = served.versions.rbegin()->first;
    } else if (auto known = CheckVersion(served, policy, version); !known.ok()) {
      return known;
    }
    settings->default_version = version;
    return absl::OkStatus();
  };
  if (auto status = Change(policy, change); !status.ok()) return status;
  return result;
}

absl::Status PolicyRegistry::SetLabel(const PolicyVersion& version, const std::string& label) {
  if (!IsPlainName(label)) {
    return absl::InvalidArgumentError(
        absl::StrCat("label: expected letters, digits, '.', '-', '_', received ", Quoted(label)));
  }
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    auto status = CheckVersion(served, version.policy, version.version);
    if (status.ok()) settings->labels[label] = version.version;
    return status;
  };
  return Change(version.policy, change);
}

absl::Status PolicyRegistry::RemoveLabel(const std::string& policy, const std::string& label) {
  return Change(policy, [&](const CatalogPolicy& /*served*/, PolicySettings* settings) {
    if (settings->labels.erase(label) == 1) return absl::OkStatus();
    return absl::NotFoundError(
        absl::StrCat("label: expected one of policy ", policy, ", received ", Quoted(label)));
  });
}

absl::Status PolicyRegistry::SetTraffic(const std::string& policy, std::vector<TrafficShare> shares,
                                        int64_t shadow_version) {
  return Change(policy, [&](const CatalogPolicy& served, PolicySettings* settings) {
    if (auto status = CheckShares(shares); !status.ok()) return status;
    for (const TrafficShare& share : shares) {
      if (auto status = CheckVersion(served, policy, share.version); !status.ok()) return status;
    }
    auto status = CheckShadow(served, policy, shares, shadow_version);
    if (status.ok()) {
      settings->shares = std::move(shares);
      settings->shadow_version = shadow_version;
    }
    return status;
  });
}

absl::Status PolicyRegistry::SetLearningPaused(const std::string& policy, bool paused) {
  absl::MutexLock lock(&change_mutex_);
  const auto catalog = this->catalog();
  if (!policy.empty()) {
    if (const auto found = catalog->FindPolicy(policy); !found.ok()) return found.status();
  }
  Settings settings = settings_;
  for (const auto& [name, served] : catalog->policies()) {
    if (policy.empty() || name == policy) settings.policies[name].learning_paused = paused;
  }
  if (auto status = Save(settings); !status.ok()) return status;
  settings_ = std::move(settings);
  for (const auto& [name, learning] : learning_) {
    learning->set_paused(settings_.policies[name].learning_paused);
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
