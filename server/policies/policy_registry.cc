#include "server/policies/policy_registry.h"

#include <utility>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

// How often files of versions that could not be taken over are tried again. A file of other bytes
// is read and hashed each time.
constexpr absl::Duration kFetchInterval = absl::Seconds(2);

}  // namespace

absl::StatusOr<std::unique_ptr<PolicyRegistry>> PolicyRegistry::Load(RegistryOptions options,
                                                                     ReloadReport* report) {
  auto registry = std::unique_ptr<PolicyRegistry>(new PolicyRegistry(std::move(options)));
  absl::MutexLock change(&registry->settings_.mutex);
  RETURN_IF_ERROR(registry->settings_.ReadFile());
  registry->folder_.Sweep();
  auto loaded = registry->ReloadOnce(/*call=*/nullptr);
  if (!loaded.ok()) return Annotate(loaded.status(), "--policies");
  *report = *std::move(loaded);
  return registry;
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

absl::Status PolicyRegistry::WithLatest(absl::FunctionRef<absl::Status()> attempt,
                                        const Span* call) {
  absl::MutexLock change(&settings_.mutex);
  absl::Status status = absl::AbortedError("");
  for (int i = 0; i < kMostAttempts && absl::IsAborted(status); ++i) {
    status = Refresh(call);
    if (status.ok()) status = attempt();
  }
  if (!absl::IsAborted(status)) return status;
  return absl::UnavailableError(absl::StrCat(status.message(), "; try again"));
}

absl::Status PolicyRegistry::Follow() {
  absl::MutexLock change(&settings_.mutex);
  return Refresh(/*call=*/nullptr);
}

absl::Status PolicyRegistry::Refresh(const Span* call) {
  // A store that is new, or has lost the settings, has lost the files that belong to them.
  ASSIGN_OR_RETURN(auto before, settings_.Follow([&] {
    settings_.mutex.AssertHeld();
    return shared_.PutAll(settings_.get());
  }));
  if (former_.has_value()) before = former_;
  // A file may be in the store by now, or have room here.
  const auto is_fetched = [&] {
    settings_.mutex.AssertHeld();
    if (missing_.empty() || clock_.Now() - fetched_ < kFetchInterval) return false;
    fetched_ = clock_.Now();
    return shared_.Fetch(settings_.get(), settings_.get(), *catalog()) != missing_;
  };
  if (!before.has_value() && is_fetched()) before = settings_.get();
  if (before.has_value()) RETURN_IF_ERROR(Enact(*before, call));
  settings_.SetJoined();
  return absl::OkStatus();
}

absl::Status PolicyRegistry::Enact(const Settings& before, const Span* call) {
  PolicyCatalog catalog = *this->catalog();
  former_ = before;
  auto missing = shared_.Fetch(before, settings_.get(), catalog);
  for (const std::string& line : missing) {
    if (!absl::c_linear_search(missing_, line)) {
      LogError("promoted version not taken over; tries again", {{"error", line}});
    }
  }
  missing_ = std::move(missing);
  RETURN_IF_ERROR(loader_.Update(settings_.get(), call, &catalog).status());
  auto waiting = settings_.ApplyTo(&catalog);
  for (const std::string& line : waiting) {
    if (!absl::c_linear_search(waiting_, line)) {
      LogWarning("a shared setting waits for its version", {{"setting", line}});
    }
  }
  waiting_ = std::move(waiting);
  loader_.SwitchLearning(settings_.get());
  Publish(std::move(catalog));
  former_ = std::nullopt;
  return absl::OkStatus();
}

absl::StatusOr<ReloadReport> PolicyRegistry::Reload(const Span* call) {
  absl::StatusOr<ReloadReport> report;
  const auto attempt = [&] {
    settings_.mutex.AssertHeld();
    report = ReloadOnce(call);
    return report.status();
  };
  RETURN_IF_ERROR(WithLatest(attempt, call));
  return report;
}

absl::StatusOr<ReloadReport> PolicyRegistry::ReloadOnce(const Span* call) {
  PolicyCatalog catalog = *this->catalog();
  ASSIGN_OR_RETURN(auto report, loader_.Update(settings_.get(), call, &catalog));
  report.waiting = settings_.ApplyTo(&catalog);
  auto kept = settings_.KeepDefaults(catalog);
  if (absl::IsAborted(kept)) {
    for (const PolicyVersion& version : report.loaded) loader_.Forget(version);
    return kept;
  }
  if (!kept.ok()) report.refused.push_back(kept);
  if (!report.loaded.empty() || !report.unloaded.empty()) Publish(std::move(catalog));
  return report;
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyRegistry::LoadVersion(
    const PolicyVersion& version, bool make_default, const Span* call) {
  RETURN_IF_ERROR(CheckPolicyName(version.policy));
  if (version.version < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("version: expected at least 1, received ", version.version));
  }
  if (!folder_.Has(version)) {
    return absl::NotFoundError(
        absl::StrCat(folder_.PathOf(version), ": expected a file that can be read"));
  }
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> served;
  const auto attempt = [&] {
    settings_.mutex.AssertHeld();
    served = LoadOnce(version, make_default, call);
    return served.status();
  };
  RETURN_IF_ERROR(WithLatest(attempt, call));
  return served;
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyRegistry::LoadOnce(
    const PolicyVersion& version, bool make_default, const Span* call) {
  Settings settings = settings_.get();
  bool changed = settings.unloaded.erase(version) == 1;
  if (make_default) {
    RETURN_IF_ERROR(ChooseDefault(version.version, &settings.policies[version.policy]));
    changed = true;
  }
  ASSIGN_OR_RETURN(auto served, loader_.Load(version, settings_.get(), call));
  auto status = changed ? settings_.Commit(std::move(settings)) : absl::OkStatus();
  PolicyCatalog catalog = *this->catalog();
  catalog.policies()[version.policy].versions[version.version] = served;
  if (status.ok()) {
    settings_.ApplyTo(&catalog);
    status = settings_.KeepDefaults(catalog);
  }
  if (!status.ok()) {
    loader_.Forget(version);  // it is not served, and the next reload finds it
    return status;
  }
  Publish(std::move(catalog));
  return served;
}

absl::Status PolicyRegistry::Unload(const PolicyVersion& version) {
  return WithLatest([&] {
    settings_.mutex.AssertHeld();
    return UnloadOnce(version);
  });
}

absl::Status PolicyRegistry::UnloadOnce(const PolicyVersion& version) {
  PolicyCatalog catalog = *this->catalog();
  ASSIGN_OR_RETURN(const auto policy, catalog.FindPolicy(version.policy));
  RETURN_IF_ERROR(policy->CheckVersion(version));
  const bool is_last = policy->versions.size() == 1;
  const std::string use = is_last ? policy->settings.DescribeUseBesideDefault(version.version)
                                  : policy->settings.DescribeUse(version.version);
  RETURN_IF_ERROR(CheckUnused(version.version, use));
  Settings settings = settings_.get();
  settings.unloaded.insert(version);
  // Otherwise a later load of this version would take the default from another one.
  if (is_last) settings.policies[version.policy].default_version = 0;
  RETURN_IF_ERROR(settings_.Commit(std::move(settings)));
  catalog.Remove(version);
  loader_.Forget(version);
  Publish(std::move(catalog));
  return absl::OkStatus();
}

absl::Status PolicyRegistry::Change(
    const std::string& policy,
    absl::FunctionRef<absl::Status(const CatalogPolicy& policy, PolicySettings* settings)> change) {
  return WithLatest([&] {
    settings_.mutex.AssertHeld();
    PolicyCatalog catalog = *this->catalog();
    ASSIGN_OR_RETURN(const auto found, catalog.FindPolicy(policy));
    Settings settings = settings_.get();
    RETURN_IF_ERROR(change(*found, &settings.policies[policy]));
    RETURN_IF_ERROR(settings_.Commit(std::move(settings)));
    settings_.ApplyTo(&catalog);
    Publish(std::move(catalog));
    return absl::OkStatus();
  });
}

absl::StatusOr<int64_t> PolicyRegistry::SetDefault(const std::string& policy, int64_t version) {
  int64_t result = version;
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    RETURN_IF_ERROR(ChooseDefault(version, settings));
    if (version != 0) return served.CheckVersion({policy, version});
    result = served.versions.rbegin()->first;
    return absl::OkStatus();
  };
  RETURN_IF_ERROR(Change(policy, change));
  return result;
}

absl::Status PolicyRegistry::ChangeHolds(
    absl::FunctionRef<absl::Status(SessionHolds::List* holds)> change) {
  return WithLatest([&] {
    settings_.mutex.AssertHeld();
    Settings settings = settings_.get();
    RETURN_IF_ERROR(change(&settings.holds));
    if (settings.holds == settings_.get().holds) return absl::OkStatus();
    return settings_.Commit(std::move(settings));
  });
}

absl::Status PolicyRegistry::SetLearningPaused(const std::string& policy, bool paused) {
  return WithLatest([&] {
    settings_.mutex.AssertHeld();
    const auto catalog = this->catalog();
    if (!policy.empty()) RETURN_IF_ERROR(catalog->FindPolicy(policy).status());
    Settings settings = settings_.get();
    for (const auto& [name, served] : catalog->policies()) {
      if (policy.empty() || name == policy) settings.policies[name].learning_paused = paused;
    }
    RETURN_IF_ERROR(settings_.Commit(std::move(settings)));
    loader_.SwitchLearning(settings_.get());
    return absl::OkStatus();
  });
}

}  // namespace spikeserve
