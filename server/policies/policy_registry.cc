#include "server/policies/policy_registry.h"

#include <utility>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/policy_file.h"
#include "server/policies/version_writer.h"
#include "server/trace/tracer.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<PolicyRegistry>> PolicyRegistry::Load(RegistryOptions options,
                                                                     NewObserver new_observer,
                                                                     ReloadReport* report) {
  const std::string settings_path = options.settings_path;
  auto registry = std::unique_ptr<PolicyRegistry>(
      new PolicyRegistry(std::move(options), std::move(new_observer)));
  absl::MutexLock change(&registry->change_mutex_);
  if (!settings_path.empty()) {
    auto settings = ReadSettings(settings_path);
    if (!settings.ok()) return Annotate(settings.status(), "--policy_settings");
    registry->holds_.Set(settings->holds);
    // A file that cannot be written would refuse the first change of an operator.
    if (auto status = registry->Commit(*std::move(settings)); !status.ok()) {
      return Annotate(
          status, "--policy_settings: expected a file in a directory that the server can write");
    }
  }
  SweepUnfinishedVersions(registry->directory());
  auto loaded = registry->ReloadOnce();
  if (!loaded.ok()) return Annotate(loaded.status(), "--policies");
  *report = *std::move(loaded);
  return registry;
}

std::vector<std::string> PolicyRegistry::ApplySettings(PolicyCatalog* catalog) const {
  std::vector<std::string> waiting;
  const auto effective_settings = [&](const std::string& name, const std::set<int64_t>& versions) {
    change_mutex_.AssertHeld();
    const auto set = settings_.policies.find(name);
    if (set == settings_.policies.end()) return PolicySettings();
    std::vector<std::string> lines;
    PolicySettings effective = EffectiveSettings(set->second, versions, &lines);
    for (const std::string& line : lines) {
      waiting.push_back(absl::StrCat(options_.settings_path, ": policies.", name, ".", line));
    }
    return effective;
  };
  for (const auto& [name, settings] : settings_.policies) {
    if (!catalog->policies().contains(name)) effective_settings(name, {});
  }
  for (auto& [name, policy] : catalog->policies()) {
    std::set<int64_t> versions;
    for (const auto& [version, served] : policy.versions) versions.insert(version);
    PolicySettings effective = effective_settings(name, versions);
    const bool follows =
        effective.default_follows_highest || options_.default_rule == DefaultRule::kHighest;
    if (effective.default_version == 0 && !follows) {
      const int64_t before = policy.settings.default_version;
      effective.default_version = versions.contains(before) ? before : *versions.rbegin();
    }
    policy.settings = std::move(effective);
  }
  return waiting;
}

absl::Status PolicyRegistry::KeepDefaults(const PolicyCatalog& catalog) {
  Settings settings = settings_;
  for (const auto& [name, policy] : catalog.policies()) {
    PolicySettings& kept = settings.policies[name];
    if (kept.default_version == 0 && !kept.default_follows_highest) {
      kept.default_version = policy.settings.default_version;  // 0 with DefaultRule::kHighest
    }
  }
  if (settings.policies == settings_.policies) return absl::OkStatus();
  auto status = Save(settings);
  if (!absl::IsAborted(status)) settings_ = std::move(settings);
  return status;
}

absl::StatusOr<std::string> PolicyRegistry::ReadVersionFile(const PolicyVersion& version) const {
  ASSIGN_OR_RETURN(auto files, ReadFiles(version));
  return std::move(files.policy);
}

absl::StatusOr<VersionFiles> PolicyRegistry::ReadFiles(const PolicyVersion& version) const {
  if (options_.withhold_files) {
    return absl::PermissionDeniedError("policy: files are withheld (--withhold_policies)");
  }
  return ReadVersionFiles(PolicyFilePath(options_.directory, version), /*with_signature=*/true);
}

bool PolicyRegistry::HasUnloaded() {
  absl::MutexLock change(&change_mutex_);
  return !settings_.unloaded.empty();
}

absl::Status PolicyRegistry::Save(const Settings& settings) {
  if (shares_settings() && has_joined()) {
    RETURN_IF_ERROR(options_.shared->Write({.revision = revision_ + 1, .json = ToJson(settings)}));
    ++revision_;
  }
  return SaveFile(settings);
}

absl::Status PolicyRegistry::SaveFile(const Settings& settings) const {
  return options_.settings_path.empty() ? absl::OkStatus()
                                        : WriteSettings(settings, options_.settings_path);
}

absl::Status PolicyRegistry::Commit(Settings settings) {
  RETURN_IF_ERROR(Save(settings));
  settings_ = std::move(settings);
  return absl::OkStatus();
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

PolicyRegistry::KnownFile PolicyRegistry::ReadKnownFile(const PolicyVersion& version) const {
  const std::string path = PolicyFilePath(options_.directory, version);
  KnownFile file = {.policy = StampOf(path), .signature = {}, .status = absl::OkStatus()};
  if (options_.signatures != nullptr) file.signature = StampOf(SignaturePath(path));
  return file;
}

absl::Status PolicyRegistry::CheckCanSign() const {
  return options_.signatures == nullptr ? absl::OkStatus() : options_.signatures->CheckCanSign();
}

absl::StatusOr<VersionFiles> PolicyRegistry::FormatVersion(const Policy& policy) const {
  ASSIGN_OR_RETURN(auto bytes, FormatPolicyFile(policy));
  VersionFiles files = {.policy = std::move(bytes), .signature = {}};
  if (options_.signatures == nullptr) return files;
  ASSIGN_OR_RETURN(files.signature, options_.signatures->Sign(files.policy));
  return files;
}

Span PolicyRegistry::StartLoad(const PolicyVersion& version) const {
  if (options_.tracer == nullptr) return {};
  Span span = call_ == nullptr ? options_.tracer->Start("load") : call_->Child("load");
  span.Set("spikeserve.policy", version.policy);
  span.Set("spikeserve.policy.version", version.version);
  return span;
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyRegistry::Read(
    const PolicyVersion& version) {
  Span span = StartLoad(version);
  // The files are looked at before they are read, so that one that changes meanwhile is read again.
  KnownFile& file = files_[version];
  file = ReadKnownFile(version);
  std::shared_ptr<LearningSwitch>& learning = learning_[version.policy];
  if (learning == nullptr) {
    learning = std::make_shared<LearningSwitch>();
    const auto set = settings_.policies.find(version.policy);
    learning->set_paused(set != settings_.policies.end() && set->second.learning_paused);
  }
  auto served = LoadPolicyVersion(options_.directory, version, options_.signatures.get(), learning,
                                  new_observer_, options_.share_heads, options_.open_log);
  file.status = served.status();
  span.Fail(file.status);
  return served;
}

absl::StatusOr<ReloadReport> PolicyRegistry::Reload(const Span* call) {
  absl::StatusOr<ReloadReport> report;
  const auto attempt = [&] {
    change_mutex_.AssertHeld();
    report = ReloadOnce();
    return report.status();
  };
  RETURN_IF_ERROR(WithLatest(attempt, call));
  return report;
}

absl::StatusOr<ReloadReport> PolicyRegistry::ReloadOnce() {
  ASSIGN_OR_RETURN(auto folders, ListPolicyFolders(options_.directory));
  ReloadReport report;
  report.refused = std::move(folders.refused);
  PolicyCatalog catalog = *this->catalog();
  LoadChanged(folders.versions, &catalog, &report);
  UnloadRemoved(&catalog, &report);
  report.waiting = ApplySettings(&catalog);
  auto kept = KeepDefaults(catalog);
  if (absl::IsAborted(kept)) return kept;
  if (!kept.ok()) report.refused.push_back(kept);
  if (!report.loaded.empty() || !report.unloaded.empty()) Publish(std::move(catalog));
  return report;
}

void PolicyRegistry::LoadChanged(const std::vector<PolicyVersion>& versions, PolicyCatalog* catalog,
                                 ReloadReport* report) {
  std::map<PolicyVersion, KnownFile> still_there;
  for (const PolicyVersion& version : versions) {
    if (settings_.unloaded.contains(version)) continue;
    const auto known = files_.find(version);
    const KnownFile found = ReadKnownFile(version);
    if (known == files_.end() || known->second.policy != found.policy ||
        known->second.signature != found.signature) {
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
    const PolicySettings& settings = policy->second.settings;
    // The default of a policy that disappears as a whole protects no other version.
    const bool none_left = absl::c_all_of(versions, [&](const auto& item) {
      return StampOf(PolicyFilePath(options_.directory, {policy->first, item.first})).size < 0;
    });
    for (auto it = versions.begin(); it != versions.end();) {
      const PolicyVersion version = {.policy = policy->first, .version = it->first};
      const std::string path = PolicyFilePath(options_.directory, version);
      const std::string use = none_left ? settings.DescribeUseBesideDefault(version.version)
                                        : settings.DescribeUse(version.version);
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
    const PolicyVersion& version, bool make_default, const Span* call) {
  if (!IsPlainName(version.policy)) {
    return absl::InvalidArgumentError(
        absl::StrCat("policy: expected a name of at most ", kLongestName,
                     " letters, digits, '.', '-', '_', received ", Quoted(version.policy)));
  }
  if (version.version < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("version: expected at least 1, received ", version.version));
  }
  if (StampOf(PolicyFilePath(options_.directory, version)).size < 0) {
    return absl::NotFoundError(absl::StrCat(PolicyFilePath(options_.directory, version),
                                            ": expected a file that can be read"));
  }
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> served;
  const auto attempt = [&] {
    change_mutex_.AssertHeld();
    served = LoadOnce(version, make_default);
    return served.status();
  };
  RETURN_IF_ERROR(WithLatest(attempt, call));
  return served;
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyRegistry::LoadOnce(
    const PolicyVersion& version, bool make_default) {
  Settings settings = settings_;
  bool changed = settings.unloaded.erase(version) == 1;
  if (make_default) {
    PolicySettings& policy = settings.policies[version.policy];
    RETURN_IF_ERROR(CheckNoRollout(policy));
    policy.default_version = version.version;
    policy.default_follows_highest = false;
    changed = true;
  }
  ASSIGN_OR_RETURN(auto served, Read(version));
  if (changed) RETURN_IF_ERROR(Commit(std::move(settings)));
  PolicyCatalog catalog = *this->catalog();
  catalog.policies()[version.policy].versions[version.version] = served;
  ApplySettings(&catalog);
  RETURN_IF_ERROR(KeepDefaults(catalog));
  Publish(std::move(catalog));
  return served;
}

absl::Status PolicyRegistry::Unload(const PolicyVersion& version) {
  return WithLatest([&] {
    change_mutex_.AssertHeld();
    return UnloadOnce(version);
  });
}

absl::Status PolicyRegistry::UnloadOnce(const PolicyVersion& version) {
  PolicyCatalog catalog = *this->catalog();
  RETURN_IF_ERROR(catalog.FindPolicy(version.policy).status());
  CatalogPolicy& policy = catalog.policies()[version.policy];
  RETURN_IF_ERROR(policy.CheckVersion(version));
  const bool is_last = policy.versions.size() == 1;
  const std::string use = is_last ? policy.settings.DescribeUseBesideDefault(version.version)
                                  : policy.settings.DescribeUse(version.version);
  if (!use.empty()) {
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one that no setting uses, received ", version.version,
                     ", which is ", use));
  }
  Settings settings = settings_;
  settings.unloaded.insert(version);
  // Otherwise a later load of this version would take the default from another one.
  if (is_last) settings.policies[version.policy].default_version = 0;
  RETURN_IF_ERROR(Commit(std::move(settings)));
  policy.versions.erase(version.version);
  if (policy.versions.empty()) catalog.policies().erase(version.policy);
  files_.erase(version);
  Publish(std::move(catalog));
  return absl::OkStatus();
}

absl::Status PolicyRegistry::Change(
    const std::string& policy,
    absl::FunctionRef<absl::Status(const CatalogPolicy& policy, PolicySettings* settings)> change) {
  return WithLatest([&] {
    change_mutex_.AssertHeld();
    PolicyCatalog catalog = *this->catalog();
    ASSIGN_OR_RETURN(const auto found, catalog.FindPolicy(policy));
    Settings settings = settings_;
    RETURN_IF_ERROR(change(*found, &settings.policies[policy]));
    RETURN_IF_ERROR(Commit(std::move(settings)));
    ApplySettings(&catalog);
    Publish(std::move(catalog));
    return absl::OkStatus();
  });
}

absl::StatusOr<int64_t> PolicyRegistry::SetDefault(const std::string& policy, int64_t version) {
  int64_t result = version;
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    RETURN_IF_ERROR(CheckNoRollout(*settings));
    if (version == 0) {
      result = served.versions.rbegin()->first;
    } else if (auto known = served.CheckVersion({policy, version}); !known.ok()) {
      return known;
    }
    settings->default_version = version;
    settings->default_follows_highest = version == 0;
    return absl::OkStatus();
  };
  RETURN_IF_ERROR(Change(policy, change));
  return result;
}

absl::Status PolicyRegistry::ChangeHolds(
    absl::FunctionRef<absl::Status(SessionHolds::List* holds)> change) {
  return WithLatest([&] {
    change_mutex_.AssertHeld();
    Settings settings = settings_;
    RETURN_IF_ERROR(change(&settings.holds));
    if (settings.holds == settings_.holds) return absl::OkStatus();
    RETURN_IF_ERROR(Commit(std::move(settings)));
    holds_.Set(settings_.holds);
    return absl::OkStatus();
  });
}

absl::Status PolicyRegistry::SetLearningPaused(const std::string& policy, bool paused) {
  return WithLatest([&] {
    change_mutex_.AssertHeld();
    const auto catalog = this->catalog();
    if (!policy.empty()) RETURN_IF_ERROR(catalog->FindPolicy(policy).status());
    Settings settings = settings_;
    for (const auto& [name, served] : catalog->policies()) {
      if (policy.empty() || name == policy) settings.policies[name].learning_paused = paused;
    }
    RETURN_IF_ERROR(Commit(std::move(settings)));
    SwitchLearning();
    return absl::OkStatus();
  });
}

void PolicyRegistry::SwitchLearning() {
  for (const auto& [name, learning] : learning_) {
    learning->set_paused(settings_.policies[name].learning_paused);
  }
}

}  // namespace spikeserve
