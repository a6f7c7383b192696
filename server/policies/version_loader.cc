#include "server/policies/version_loader.h"

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/learning/tenant_heads.h"
#include "server/trace/tracer.h"

namespace spikeserve {
namespace {

// Begins the span of a load.
Span StartLoad(Tracer* tracer, const Span* call, const PolicyVersion& version) {
  if (tracer == nullptr) return {};
  Span span = call == nullptr ? tracer->Start("load") : call->Child("load");
  span.Set("spikeserve.policy", version.policy);
  span.Set("spikeserve.policy.version", version.version);
  return span;
}

bool IsPaused(const Settings& settings, const std::string& policy) {
  const auto set = settings.policies.find(policy);
  return set != settings.policies.end() && set->second.learning_paused;
}

}  // namespace

absl::StatusOr<std::shared_ptr<const ServedPolicy>> VersionLoader::Load(
    const PolicyVersion& version, const Settings& settings, const Span* call) {
  Span span = StartLoad(options_.tracer, call, version);
  // The files are looked at before they are read, so that one that changes meanwhile is read again.
  KnownFiles& known = files_[version];
  known.stamps = folder_.StampsOf(version);
  auto opened = folder_.Open(version);
  known.status = opened.status();
  span.Fail(known.status);
  RETURN_IF_ERROR(known.status);
  std::shared_ptr<LearningSwitch>& learning = learning_[version.policy];
  if (learning == nullptr) {
    learning = std::make_shared<LearningSwitch>();
    learning->set_paused(IsPaused(settings, version.policy));
  }
  auto served = std::make_shared<ServedPolicy>();
  served->name = version.policy;
  served->version = version.version;
  served->sha256 = std::move(opened->sha256);
  served->engine = std::move(opened->engine);
  const std::shared_ptr<const Policy> shared(served->engine, &served->policy());
  served->learning = learning;
  if (options_.open_log != nullptr) served->log = options_.open_log(*served);
  served->heads =
      served->log != nullptr ? served->log->heads() : std::make_shared<TenantHeads>(shared);
  served->share_heads = options_.share_heads;
  served->heads->Of("");  // exists before a session learns it
  served->observer = options_.new_observer(served->name, served->version, served->policy());
  return served;
}

absl::StatusOr<ReloadReport> VersionLoader::Update(const Settings& settings, const Span* call,
                                                   PolicyCatalog* catalog) {
  ASSIGN_OR_RETURN(auto listing, folder_.List());
  ReloadReport report;
  report.refused = std::move(listing.refused);
  for (const PolicyVersion& version : settings.unloaded) {
    catalog->Remove(version);
    Forget(version);
  }
  LoadChanged(listing.versions, settings, call, catalog, &report);
  RemoveGone(catalog, &report);
  return report;
}

void VersionLoader::LoadChanged(const std::vector<PolicyVersion>& versions,
                                const Settings& settings, const Span* call, PolicyCatalog* catalog,
                                ReloadReport* report) {
  std::map<PolicyVersion, KnownFiles> still_there;
  for (const PolicyVersion& version : versions) {
    if (settings.unloaded.contains(version)) continue;
    const auto known = files_.find(version);
    if (known == files_.end() || known->second.stamps != folder_.StampsOf(version)) {
      if (auto served = Load(version, settings, call); served.ok()) {
        catalog->policies()[version.policy].versions[version.version] = *std::move(served);
        report->loaded.push_back(version);
      }
    }
    const KnownFiles& files = files_[version];
    if (!files.status.ok()) report->refused.push_back(files.status);
    still_there.emplace(version, files);
  }
  files_ = std::move(still_there);
}

void VersionLoader::RemoveGone(PolicyCatalog* catalog, ReloadReport* report) const {
  const PolicyCatalog before = *catalog;
  for (const auto& [name, policy] : before.policies()) {
    // The default of a policy that disappears as a whole protects no other version.
    const bool none_left = absl::c_none_of(policy.versions, [this, &name = name](const auto& item) {
      return folder_.Has({.policy = name, .version = item.first});
    });
    for (const auto& [number, served] : policy.versions) {
      const PolicyVersion version = {.policy = name, .version = number};
      if (folder_.Has(version)) continue;
      const std::string use = none_left ? policy.settings.DescribeUseBesideDefault(number)
                                        : policy.settings.DescribeUse(number);
      if (use.empty()) {
        report->unloaded.push_back(version);
        catalog->Remove(version);
      } else {
        report->refused.push_back(absl::FailedPreconditionError(
            absl::StrCat(folder_.PathOf(version),
                         ": the file is gone; the version is served because it is ", use)));
      }
    }
  }
}

void VersionLoader::SwitchLearning(const Settings& settings) {
  for (const auto& [name, learning] : learning_) learning->set_paused(IsPaused(settings, name));
}

}  // namespace spikeserve
