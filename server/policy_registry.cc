#include "server/policy_registry.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "core/model/json.h"

namespace spikeserve {
namespace {

// NOT_FOUND unless the policy has this version.
absl::Status CheckVersion(const CatalogPolicy& policy, const std::string& name, int64_t version) {
  if (policy.versions.contains(version)) return absl::OkStatus();
  return absl::NotFoundError(absl::StrCat("version: expected one that is served of policy ", name,
                                          ", received ", version));
}

absl::Status CheckShares(const CatalogPolicy& policy, const std::string& name,
                         const std::vector<TrafficShare>& shares) {
  int sum = 0;
  std::set<int64_t> seen;
  for (const TrafficShare& share : shares) {
    if (auto status = CheckVersion(policy, name, share.version); !status.ok()) return status;
    if (share.percent < 0 || share.percent > 100) {
      return absl::InvalidArgumentError(
          absl::StrCat("shares: expected percents in [0, 100], received ", share.percent,
                       " for version ", share.version));
    }
    if (!seen.insert(share.version).second) {
      return absl::InvalidArgumentError(
          absl::StrCat("shares: expected each version once, received ", share.version, " twice"));
    }
    sum += share.percent;
  }
  if (shares.empty() || sum == 100) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("shares: expected percents that add up to 100, received ", sum));
}

// The shadow must fit every version that gets sessions without naming one.
absl::Status CheckShadow(const CatalogPolicy& policy, const std::string& name) {
  if (policy.settings.shadow_version == 0) return absl::OkStatus();
  if (auto status = CheckVersion(policy, name, policy.settings.shadow_version); !status.ok())
    return status;
  std::vector<TrafficShare> shadowed = policy.settings.shares;
  if (shadowed.empty()) shadowed = {{.version = policy.DefaultVersion(), .percent = 100}};
  for (const TrafficShare& share : shadowed) {
    if (SameSpaces(*policy.versions.at(share.version),
                   *policy.versions.at(policy.settings.shadow_version))) {
      continue;
    }
    return absl::FailedPreconditionError(
        absl::StrCat("shadow_version: expected the observations and actions of version ",
                     share.version, ", received version ", policy.settings.shadow_version));
  }
  return absl::OkStatus();
}

absl::Status Prefixed(absl::string_view prefix, const absl::Status& status) {
  return absl::Status(status.code(), absl::StrCat(prefix, ": ", status.message()));
}

}  // namespace

absl::StatusOr<std::unique_ptr<PolicyRegistry>> PolicyRegistry::Load(
    const std::string& directory, const std::string& settings_path, NewObserver new_observer,
    std::vector<absl::Status>* refused) {
  auto registry =
      std::unique_ptr<PolicyRegistry>(new PolicyRegistry(directory, std::move(new_observer)));
  Settings settings;
  if (!settings_path.empty()) {
    auto read = ReadSettings(settings_path);
    if (!read.ok()) return Prefixed("--policy_settings", read.status());
    settings = *std::move(read);
  }
  {
    absl::MutexLock change(&registry->change_mutex_);
    registry->kept_out_ = settings.unloaded;
  }
  auto report = registry->Reload();
  if (!report.ok()) return Prefixed("--policies", report.status());
  *refused = std::move(report->refused);
  for (const auto& [policy, set] : settings.policies) {
    for (const absl::Status& status : registry->Restore(policy, set)) {
      refused->push_back(Prefixed(settings_path, status));
    }
  }
  absl::MutexLock change(&registry->change_mutex_);
  registry->settings_path_ = settings_path;
  return registry;
}

std::vector<absl::Status> PolicyRegistry::Restore(const std::string& policy,
                                                  const PolicySettings& settings) {
  std::vector<absl::Status> refused;
  const auto keep = [&](const std::string& setting, const absl::Status& status) {
    if (status.ok()) return;
    refused.push_back(Prefixed(absl::StrCat("policies.", policy, ".", setting), status));
  };
  if (settings.default_version != 0) {
    keep("default_version", SetDefault(policy, settings.default_version).status());
  }
  for (const auto& [label, version] : settings.labels) {
    keep(absl::StrCat("labels.", label), SetLabel({.policy = policy, .version = version}, label));
  }
  if (!settings.shares.empty() || settings.shadow_version != 0) {
    keep("shares", SetTraffic(policy, settings.shares, settings.shadow_version));
  }
  return refused;
}

absl::Status PolicyRegistry::Save(const PolicyCatalog& catalog) const {
  if (settings_path_.empty()) return absl::OkStatus();
  Settings settings = {.policies = {}, .unloaded = kept_out_};
  for (const auto& [name, policy] : catalog.policies()) settings.policies[name] = policy.settings;
  return WriteSettings(settings, settings_path_);
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
  // The stamp first: a file that changes while it is read is read again.
  KnownFile& file = files_[version];
  file.stamp = StampOf(PolicyFilePath(directory_, version));
  std::shared_ptr<LearningSwitch>& learning = learning_[version.policy];
  if (learning == nullptr) learning = std::make_shared<LearningSwitch>();
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
  DropGone(&catalog, &report);
  if (!report.loaded.empty() || !report.unloaded.empty()) Publish(std::move(catalog));
  return report;
}

void PolicyRegistry::LoadChanged(const std::vector<PolicyVersion>& versions, PolicyCatalog* catalog,
                                 ReloadReport* report) {
  std::map<PolicyVersion, KnownFile> still_there;
  for (const PolicyVersion& version : versions) {
    if (kept_out_.contains(version)) continue;
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

void PolicyRegistry::DropGone(PolicyCatalog* catalog, ReloadReport* report) {
  for (auto policy = catalog->policies().begin(); policy != catalog->policies().end();) {
    auto& versions = policy->second.versions;
    for (auto it = versions.begin(); it != versions.end();) {
      const PolicyVersion version = {.policy = policy->first, .version = it->first};
      const std::string path = PolicyFilePath(directory_, version);
      const std::string use = policy->second.UseOf(version.version);
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
  const bool was_kept_out = kept_out_.erase(version) == 1;
  PolicyCatalog catalog = *this->catalog();
  catalog.policies()[version.policy].versions[version.version] = *served;
  if (auto status = was_kept_out ? Save(catalog) : absl::OkStatus(); !status.ok()) {
    kept_out_.insert(version);
    return status;
  }
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
  if (const std::string use = policy.UseOf(version.version); !use.empty()) {
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one that nothing was set to, received ", version.version,
                     ", which is ", use));
  }
  policy.versions.erase(version.version);
  if (policy.versions.empty()) catalog.policies().erase(version.policy);
  kept_out_.insert(version);
  if (auto status = Save(catalog); !status.ok()) {
    kept_out_.erase(version);
    return status;
  }
  files_.erase(version);
  Publish(std::move(catalog));
  return absl::OkStatus();
}

absl::Status PolicyRegistry::Change(const std::string& policy,
                                    absl::FunctionRef<absl::Status(CatalogPolicy& policy)> change) {
  absl::MutexLock lock(&change_mutex_);
  PolicyCatalog catalog = *this->catalog();
  if (const auto found = catalog.FindPolicy(policy); !found.ok()) return found.status();
  if (auto status = change(catalog.policies()[policy]); !status.ok()) return status;
  if (auto status = Save(catalog); !status.ok()) return status;
  Publish(std::move(catalog));
  return absl::OkStatus();
}

absl::StatusOr<int64_t> PolicyRegistry::SetDefault(const std::string& policy, int64_t version) {
  int64_t result = 0;
  const absl::Status status = Change(policy, [&](CatalogPolicy& changed) {
    if (version != 0) {
      if (auto known = CheckVersion(changed, policy, version); !known.ok()) return known;
    }
    changed.settings.default_version = version;
    result = changed.DefaultVersion();
    return absl::OkStatus();
  });
  if (!status.ok()) return status;
  return result;
}

absl::Status PolicyRegistry::SetLabel(const PolicyVersion& version, const std::string& label) {
  if (!IsPlainName(label)) {
    return absl::InvalidArgumentError(
        absl::StrCat("label: expected letters, digits, '.', '-', '_', received ", Quoted(label)));
  }
  return Change(version.policy, [&](CatalogPolicy& changed) {
    if (auto status = CheckVersion(changed, version.policy, version.version); !status.ok()) {
      return status;
    }
    changed.settings.labels[label] = version.version;
    return absl::OkStatus();
  });
}

absl::Status PolicyRegistry::RemoveLabel(const std::string& policy, const std::string& label) {
  return Change(policy, [&](CatalogPolicy& changed) {
    if (changed.settings.labels.erase(label) == 1) return absl::OkStatus();
    return absl::NotFoundError(
        absl::StrCat("label: expected one of policy ", policy, ", received ", Quoted(label)));
  });
}

absl::Status PolicyRegistry::SetTraffic(const std::string& policy, std::vector<TrafficShare> shares,
                                        int64_t shadow_version) {
  return Change(policy, [&](CatalogPolicy& changed) {
    if (auto status = CheckShares(changed, policy, shares); !status.ok()) return status;
    changed.settings.shares = std::move(shares);
    changed.settings.shadow_version = shadow_version;
    return CheckShadow(changed, policy);
  });
}

}  // namespace spikeserve
