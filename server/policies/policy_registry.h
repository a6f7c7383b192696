// Loads, replaces and unloads policy versions while sessions run, and applies the settings of
// operators.
//
// Thread-safe. catalog() returns an immutable snapshot that a reader may keep. Changes run one at a
// time and read files without blocking readers. A session keeps the version it was opened on. If
// there is a settings file, a setting is written to it before it takes effect, so that it survives
// a restart. Several servers may share their settings (SharedSettings); a setting is then written
// there first, and the changes of the others are taken over by Follow().
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "core/base/enum_names.h"
#include "server/policies/policy_catalog.h"
#include "server/policies/policy_repository.h"
#include "server/policies/policy_signatures.h"
#include "server/policies/session_holds.h"
#include "server/policies/shared_settings.h"

namespace spikeserve {

class Span;
class Tracer;

// The result of Reload.
struct ReloadReport {
  std::vector<PolicyVersion> loaded;    // new versions, and versions whose file changed
  std::vector<PolicyVersion> unloaded;  // versions whose files were removed
  std::vector<absl::Status> refused;    // all current problems; messages start with the path
  std::vector<std::string> waiting;     // settings whose version is not served; start with the path
};

// What the default version of a policy does, unless an operator sets it, when versions are loaded.
// It begins as the highest version.
enum class DefaultRule {
  kStay,     // stays the version that it is
  kHighest,  // is always the highest version
};

constexpr std::array<EnumName<DefaultRule>, 2> EnumNames(DefaultRule) {
  return {{{DefaultRule::kStay, "stay"}, {DefaultRule::kHighest, "highest"}}};
}

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
  bool share_heads = false;          // see LoadPolicyVersion
  bool withhold_files = false;       // see ReadVersionFile
  SharedSettings* shared = nullptr;  // null: the settings are those of this server
  OpenHeadLog open_log = nullptr;    // see LoadPolicyVersion
  std::shared_ptr<const PolicySignatures> signatures = nullptr;  // null: versions need no signature
  Tracer* tracer = nullptr;                                      // null: nothing is traced
};

class PolicyRegistry {
 public:
  // Removes what killed processes have left in the directory (SweepUnfinishedVersions). Then
  // loads the policies of the directory, and the settings unless their path is empty. Files that
  // cannot be loaded are listed in `report`; all others are served. A setting whose version is not
  // served is kept and takes effect when the version is loaded. Returns NOT_FOUND if there is no
  // such directory, INVALID_ARGUMENT if the settings file is not valid, and the error of the system
  // if it cannot be written.
  static absl::StatusOr<std::unique_ptr<PolicyRegistry>> Load(RegistryOptions options,
                                                              NewObserver new_observer,
                                                              ReloadReport* report);

  // Returns the current snapshot. Never null.
  std::shared_ptr<const PolicyCatalog> catalog() const;

  const std::string& directory() const { return options_.directory; }

  // Returns the content of a version's file, for the robots that play it, and PERMISSION_DENIED if
  // files are withheld. The file may have been replaced since the version was loaded.
  absl::StatusOr<std::string> ReadVersionFile(const PolicyVersion& version) const;
  // As above, with the signature.
  absl::StatusOr<VersionFiles> ReadFiles(const PolicyVersion& version) const;

  // Returns true if operators have unloaded versions that are not loaded again.
  bool HasUnloaded();

  // The methods below return UNAVAILABLE if the shared settings cannot be reached.

  // Takes over the settings that other servers have changed, and the versions that they have
  // promoted. The first server writes its own settings. Does nothing without shared settings.
  absl::Status Follow();

  // Returns true if settings are shared.
  bool shares_settings() const { return options_.shared != nullptr; }
  // Returns true if settings outlive this server.
  bool keeps_settings() const { return shares_settings() || !options_.settings_path.empty(); }
  // Returns true once the shared settings were taken over.
  bool has_joined() const { return joined_.load(std::memory_order_acquire); }

  // Returns FAILED_PRECONDITION if versions need a signature and this server cannot sign them.
  absl::Status CheckCanSign() const;

  // Returns the files of a version that this server makes of `policy`, with a signature if versions
  // need one. INVALID_ARGUMENT if the policy is not valid, and the error of CheckCanSign().
  absl::StatusOr<VersionFiles> FormatVersion(const Policy& policy) const;

  // Returns INVALID_ARGUMENT unless the name is valid and TryVersion() accepts the files, whose
  // signature, if versions need one, has to be that of the statement of their version.
  absl::Status CheckPushed(const NewVersion& added) const;

  // Writes a version, on all servers that share settings, and serves it. ALREADY_EXISTS if the
  // policy has or had this version, and the errors of LoadVersion(); then nothing is left behind.
  absl::StatusOr<PolicyVersion> AddVersion(const NewVersion& added);

  // Returns the versions of a policy that were pushed, ascending.
  std::vector<PolicyVersion> PushedVersions(const std::string& policy) const;

  // Removes a version that was pushed, or promoted on servers that share settings, on all of these.
  // Its number is not used again. Returns how many bytes its files had here; NOT_FOUND if there is
  // no such version, and FAILED_PRECONDITION if a setting uses it as in Unload(), or an operator
  // has written its file.
  absl::StatusOr<int64_t> RemoveStored(const PolicyVersion& version);

  // Updates the catalog from the directory: loads new and changed files, and unloads versions whose
  // files were removed, unless a setting uses them. If a changed file is refused, the version that
  // was loaded before stays. Returns NOT_FOUND and changes nothing if the directory cannot be read.
  // The spans of loads belong to `call`; null: to none, as those of the start.
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

  // The holds of sessions, which outlive this call.
  const SessionHolds& holds() const { return holds_; }
  // Applies `change` to the holds, saves them and puts them into force, as Change() does.
  absl::Status ChangeHolds(absl::FunctionRef<absl::Status(SessionHolds::List* holds)> change);

  // Pauses or resumes learning in all versions of a policy, or of all served policies if `policy`
  // is empty. After a pause has returned, their shared heads do not change.
  absl::Status SetLearningPaused(const std::string& policy, bool paused);

 private:
  // The state of a version's files when they were last read.
  struct KnownFile {
    FileStamp policy;
    FileStamp signature;  // of no file if versions need no signature
    absl::Status status;  // OK, or why the version was refused
  };

  // Returns the state of a version's files now.
  KnownFile ReadKnownFile(const PolicyVersion& version) const;

  PolicyRegistry(RegistryOptions options, NewObserver new_observer)
      : options_(std::move(options)),
        new_observer_(std::move(new_observer)),
        joined_(options_.shared == nullptr) {}

  // Calls `attempt` with the mutex held, and calls it again with the new settings whenever it
  // returns ABORTED because another server has changed them. `call`: the change belongs to it.
  absl::Status WithLatest(absl::FunctionRef<absl::Status()> attempt, const Span* call = nullptr)
      ABSL_LOCKS_EXCLUDED(change_mutex_);
  // As Follow().
  absl::Status Refresh() ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  // Puts the settings of other servers into force.
  absl::Status Adopt(const SharedSettings::Document& document)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  // Writes the files of stored versions that this server does not have, and removes those of
  // versions that another server has removed since the settings were `before`. Logs what fails.
  void FetchStored(const Settings& before) ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  // Reads the files of a stored version from the shared ones. INVALID_ARGUMENT if they are not what
  // they should be.
  absl::StatusOr<VersionFiles> FetchFiles(const PolicyVersion& version, const std::string& sha256);
  // Writes the files of a version to the shared ones.
  absl::Status PutFiles(const PolicyVersion& version, const VersionFiles& files,
                        const std::string& sha256);

  // Each is one attempt of the public method of its name.
  absl::StatusOr<ReloadReport> ReloadOnce() ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadOnce(const PolicyVersion& version,
                                                               bool make_default)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  absl::Status UnloadOnce(const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  absl::StatusOr<PolicyVersion> AddOnce(const NewVersion& added)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  absl::Status ShareOnce(const NewVersion& added, const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  absl::Status RemoveOnce(const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  // Returns true if the policy has this version, or a former one had its number.
  bool IsTaken(const PolicyVersion& version) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  // Returns the number above every one for which IsTaken().
  int64_t NextNumber(const std::string& policy) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  // Pauses and resumes learning as the settings say.
  void SwitchLearning() ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  void Publish(PolicyCatalog catalog) ABSL_LOCKS_EXCLUDED(mutex_);

  // Puts into force the settings whose versions are in `catalog`. A default that waits for its
  // version, or was never set, stays the version that it was; if there was none, it is the highest.
  // Returns one line for each setting that waits for its version.
  std::vector<std::string> ApplySettings(PolicyCatalog* catalog) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  // Adds to the settings the defaults that are in force and were never set, so that neither a later
  // load nor a restart moves them. Writes the settings if that changes them.
  absl::Status KeepDefaults(const PolicyCatalog& catalog)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  // Writes the settings to the shared ones and to their file, if there are any. Returns ABORTED if
  // another server has changed them since they were read.
  absl::Status Save(const Settings& settings) ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  absl::Status SaveFile(const Settings& settings) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  // As Save(), and puts the settings into force if that succeeds.
  absl::Status Commit(Settings settings) ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  // Begins the span of a load.
  Span StartLoad(const PolicyVersion& version) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> Read(const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  void LoadChanged(const std::vector<PolicyVersion>& versions, PolicyCatalog* catalog,
                   ReloadReport* report) ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  void UnloadRemoved(PolicyCatalog* catalog, ReloadReport* report)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  const RegistryOptions options_;
  const NewObserver new_observer_;
  std::atomic<bool> joined_;
  SessionHolds holds_;  // those of settings_

  absl::Mutex change_mutex_;  // held during a whole change; taken before mutex_
  const Span* call_ ABSL_GUARDED_BY(change_mutex_) =
      nullptr;  // that the change belongs to, or null
  std::map<PolicyVersion, KnownFile> files_ ABSL_GUARDED_BY(change_mutex_);
  // All settings of operators, including those that wait for a version; the catalog has those that
  // are in force.
  Settings settings_ ABSL_GUARDED_BY(change_mutex_);
  int64_t revision_ ABSL_GUARDED_BY(change_mutex_) = 0;  // of the shared settings in `settings_`
  std::vector<std::string> waiting_ ABSL_GUARDED_BY(change_mutex_);  // of those, as last logged
  // By policy: all versions share one switch, so that a pause also covers versions loaded later.
  std::map<std::string, std::shared_ptr<LearningSwitch>> learning_ ABSL_GUARDED_BY(change_mutex_);

  mutable absl::Mutex mutex_;  // held only to copy or swap the pointer
  std::shared_ptr<const PolicyCatalog> catalog_ ABSL_GUARDED_BY(mutex_) =
      std::make_shared<const PolicyCatalog>();
};

}  // namespace spikeserve
