// Loads the versions of a policy folder, as they are served, and finds those that have changed.
//
// Not thread-safe.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/head_log.h"
#include "core/agent/served_policy.h"
#include "server/policies/policy_catalog.h"
#include "server/policies/policy_folder.h"
#include "server/policies/policy_settings.h"

namespace spikeserve {

class Span;
class Tracer;

// Makes the observer of one policy version.
using NewObserver = std::function<std::shared_ptr<SessionObserver>(
    const std::string& name, int64_t version, const Policy& policy)>;

struct LoaderOptions {
  NewObserver new_observer;
  // The fleet sessions of all tenants learn one head; otherwise each tenant has its own.
  bool share_heads = false;
  // Opens the log that changes the heads; null: they are those of this process alone.
  OpenHeadLog open_log = nullptr;
  Tracer* tracer = nullptr;  // null: nothing is traced
};

// What an update of the catalog has changed.
struct ReloadReport {
  std::vector<PolicyVersion> loaded;    // new versions, and versions whose file changed
  std::vector<PolicyVersion> unloaded;  // versions whose files were removed
  std::vector<absl::Status> refused;    // all current problems; messages start with the path
  std::vector<std::string> waiting;     // settings whose version is not served; start with the path
};

class VersionLoader {
 public:
  // `folder` must outlive the loader.
  VersionLoader(const PolicyFolder* folder, LoaderOptions options)
      : folder_(*folder), options_(std::move(options)) {}

  // Loads a version. Returns the errors of PolicyFolder::Open(). The span of the load belongs to
  // `call`; null: to none.
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> Load(const PolicyVersion& version,
                                                           const Settings& settings,
                                                           const Span* call);

  // Updates the catalog from the folder: loads new and changed files, and removes versions that are
  // unloaded, or whose files were removed unless a setting in force uses them. If a changed file is
  // refused, the version that was loaded before stays. Returns NOT_FOUND and changes nothing if the
  // folder cannot be read. `call` as for Load().
  absl::StatusOr<ReloadReport> Update(const Settings& settings, const Span* call,
                                      PolicyCatalog* catalog);

  // Forgets that a version was loaded, so that Update() loads it again.
  void Forget(const PolicyVersion& version) { files_.erase(version); }

  // Pauses and resumes learning as the settings say. After a pause has returned, shared heads do
  // not change.
  void SwitchLearning(const Settings& settings);

 private:
  // A version's files when they were last read.
  struct KnownFiles {
    PolicyFolder::Stamps stamps;
    absl::Status status;  // OK, or why the version was refused
  };

  void LoadChanged(const std::vector<PolicyVersion>& versions, const Settings& settings,
                   const Span* call, PolicyCatalog* catalog, ReloadReport* report);
  void RemoveGone(PolicyCatalog* catalog, ReloadReport* report) const;

  const PolicyFolder& folder_;
  const LoaderOptions options_;
  std::map<PolicyVersion, KnownFiles> files_;
  // By policy: all versions share one switch, so that a pause also covers versions loaded later.
  std::map<std::string, std::shared_ptr<LearningSwitch>> learning_;
};

}  // namespace spikeserve
