// Loads, replaces and unloads policy versions while sessions run, and applies the settings of
// operators: changes the folder, the settings and the catalog of what is served together.
//
// Thread-safe. catalog() returns an immutable snapshot that a reader may keep. Changes run one at a
// time and read files without blocking readers. A session keeps the version it was opened on.
// Several servers may share their settings (SharedSettings); a setting is then written there first,
// and the changes of the others are taken over by Follow().
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/policies/operator_settings.h"
#include "server/policies/policy_catalog.h"
#include "server/policies/policy_folder.h"
#include "server/policies/shared_settings.h"
#include "server/policies/shared_versions.h"
#include "server/policies/version_loader.h"

namespace spikeserve {

// A version that a server makes or is sent.
struct NewVersion {
  std::string policy;
  int64_t version = 0;  // 0: one above every version that the policy has or had
  VersionFiles files;
  bool make_default = false;
};

struct RegistryOptions {
  std::string directory;           // of the policies
  std::string settings_path = "";  // empty: settings are not saved
  DefaultRule default_rule = DefaultRule::kStay;
  bool withhold_files = false;       // see PolicyFolder
  SharedSettings* shared = nullptr;  // null: the settings are those of this server
  std::shared_ptr<const PolicySignatures> signatures = nullptr;  // null: versions need no signature
  LoaderOptions loader = {};
};

class PolicyRegistry {
 public:
  // Sweeps the directory. Then loads its policies, and the settings unless their path is empty.
  // Files that cannot be loaded are listed in `report`; all others are served. A setting whose
  // version is not served is kept and takes effect when the version is loaded. Returns NOT_FOUND if
  // there is no such directory, INVALID_ARGUMENT if the settings file is not valid, and the error
  // of the system if it cannot be written.
  static absl::StatusOr<std::unique_ptr<PolicyRegistry>> Load(RegistryOptions options,
                                                              ReloadReport* report);

  const PolicyFolder& folder() const { return folder_; }
  const OperatorSettings& settings() const { return settings_; }
  // Returns the current snapshot. Never null.
  std::shared_ptr<const PolicyCatalog> catalog() const ABSL_LOCKS_EXCLUDED(mutex_);

  // The methods below return UNAVAILABLE if the shared settings cannot be reached.

  // Takes over the settings that other servers have changed, and the versions that they have
  // promoted. The first server writes its own settings. Does nothing without shared settings.
  absl::Status Follow();

  // Writes a version, on all servers that share settings, and serves it. ALREADY_EXISTS if the
  // policy has or had this version, and the errors of LoadVersion(); then nothing is left behind.
  absl::StatusOr<PolicyVersion> AddVersion(const NewVersion& added);

  // Removes a version that was pushed, or promoted on servers that share settings, on all of these.
  // Its number is not used again. Returns how many bytes its files had here; NOT_FOUND if there is
  // no such version, and FAILED_PRECONDITION if a setting uses it as in Unload(), or an operator
  // has written its file.
  absl::StatusOr<int64_t> RemoveStored(const PolicyVersion& version);

  // Updates the catalog from the folder (VersionLoader::Update). The spans of loads belong to
  // `call`; null: to none, as those of the start.
  absl::StatusOr<ReloadReport> Reload(const Span* call = nullptr);

  // Loads this version now and replaces a version of the same number, even if its file has not
  // changed. If `make_default`, it also becomes the default. Returns NOT_FOUND if there is no file
  // and INVALID_ARGUMENT if it is refused; then nothing changes. `call` as for Reload().
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadVersion(const PolicyVersion& version,
                                                                  bool make_default = false,
                                                                  const Span* call = nullptr);

  // The methods below return NOT_FOUND and change nothing if the policy or version is not served.

  // Unloads a version. Reload does not load it again until LoadVersion was called for it. Returns
  // FAILED_PRECONDITION while a setting of an operator uses it, or it is the default and the policy
  // has other versions.
  absl::Status Unload(const PolicyVersion& version);

  // Sets the default version; 0 makes the default follow the highest version, now and after later
  // loads. Returns the version that is the default now, and FAILED_PRECONDITION while a roll-out of
  // the policy is running, because it sets the default.
  absl::StatusOr<int64_t> SetDefault(const std::string& policy, int64_t version);

  // Applies `change` to the settings of the policy, saves them and puts them into force. `policy`
  // is the state before the change. If `change` returns an error, nothing changes. `change` is
  // called again if another server has changed the settings meanwhile.
  absl::Status Change(
      const std::string& policy,
      absl::FunctionRef<absl::Status(const CatalogPolicy& policy, PolicySettings* settings)>
          change);

  // Applies `change` to the holds, saves them and puts them into force, as Change() does.
  absl::Status ChangeHolds(absl::FunctionRef<absl::Status(SessionHolds::List* holds)> change);

  // Pauses or resumes learning in all versions of a policy, or of all served policies if `policy`
  // is empty. After a pause has returned, their shared heads do not change.
  absl::Status SetLearningPaused(const std::string& policy, bool paused);

 private:
  explicit PolicyRegistry(RegistryOptions options)
      : folder_(std::move(options.directory), std::move(options.signatures),
                options.withhold_files),
        settings_(std::move(options.settings_path), options.default_rule, options.shared),
        shared_(options.shared, &folder_),
        loader_(&folder_, std::move(options.loader)) {}

  // Calls `attempt` with the mutex held, and calls it again with the new settings whenever it
  // returns ABORTED because another server has changed them. `call`: the change belongs to it.
  absl::Status WithLatest(absl::FunctionRef<absl::Status()> attempt, const Span* call = nullptr)
      ABSL_LOCKS_EXCLUDED(settings_.mutex);
  // As Follow().
  absl::Status Refresh(const Span* call) ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);
  // Puts settings into force that were `before`: those of other servers, and those of AddVersion().
  absl::Status Enact(const Settings& before, const Span* call)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);

  // Each is one attempt of the public method of its name.
  absl::StatusOr<ReloadReport> ReloadOnce(const Span* call)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadOnce(const PolicyVersion& version,
                                                               bool make_default, const Span* call)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);
  absl::Status UnloadOnce(const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);
  absl::StatusOr<PolicyVersion> AddOnce(const NewVersion& added)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);
  absl::Status ShareOnce(const NewVersion& added, const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);
  absl::Status RemoveOnce(const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(settings_.mutex);

  void Publish(PolicyCatalog catalog) ABSL_LOCKS_EXCLUDED(mutex_);

  const PolicyFolder folder_;
  OperatorSettings settings_;  // its mutex is taken before mutex_
  const SharedVersions shared_;
  VersionLoader loader_ ABSL_GUARDED_BY(settings_.mutex);
  // The settings that waited for their version, and the shared files that could not be fetched,
  // when they were last logged.
  std::vector<std::string> waiting_ ABSL_GUARDED_BY(settings_.mutex);
  std::vector<std::string> missing_ ABSL_GUARDED_BY(settings_.mutex);
  const SteadyClock clock_;
  absl::Duration fetched_ ABSL_GUARDED_BY(settings_.mutex);  // when `missing_` was tried again
  // The settings that were in force before those that Enact() has not put into force yet.
  std::optional<Settings> former_ ABSL_GUARDED_BY(settings_.mutex);

  mutable absl::Mutex mutex_;  // held only to copy or swap the pointer
  std::shared_ptr<const PolicyCatalog> catalog_ ABSL_GUARDED_BY(mutex_) =
      std::make_shared<const PolicyCatalog>();
};

}  // namespace spikeserve
