// The policy versions a server serves, live: versions come and go while sessions run.
//
// Thread-safe. Readers take a snapshot and keep it for as long as they like; changes are made one
// at a time, files are read outside of the readers' lock, and a session keeps the version it was
// opened on. What an operator sets is written to a file before it holds, where there is one, so
// that it outlives the server.
#ifndef SERVER_POLICIES_POLICY_REGISTRY_H_
#define SERVER_POLICIES_POLICY_REGISTRY_H_

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
#include "server/policies/policy_catalog.h"
#include "server/policies/policy_repository.h"

namespace spikeserve {

// What Reload did.
struct ReloadReport {
  std::vector<PolicyVersion> loaded;    // new, or read again because the file changed
  std::vector<PolicyVersion> unloaded;  // their files are gone
  std::vector<absl::Status> refused;    // everything that is amiss now; the path comes first
  std::vector<std::string> waiting;  // settings whose version is not served; the path comes first
};

class PolicyRegistry {
 public:
  // Loads what can be loaded, and puts back what operators have set as `settings_path` tells, if it
  // is not empty. What cannot be is told in `report`; everything else is served. A setting whose
  // version is not there is kept, and holds once the version is. NOT_FOUND if there is no such
  // directory, INVALID_ARGUMENT for settings that cannot be read.
  static absl::StatusOr<std::unique_ptr<PolicyRegistry>> Load(const std::string& directory,
                                                              const std::string& settings_path,
                                                              NewObserver new_observer,
                                                              ReloadReport* report);

  // What is served now. Never null.
  std::shared_ptr<const PolicyCatalog> catalog() const;

  const std::string& directory() const { return directory_; }

  // Brings the catalog in line with the directory: reads new and changed files, and drops versions
  // whose files are gone unless an operator set something to them. A file that is refused changes
  // nothing: the version that was read before goes on. NOT_FOUND if the directory cannot be read;
  // then nothing changes.
  absl::StatusOr<ReloadReport> Reload();

  // Reads this version now, whatever was served under its number. NOT_FOUND without a file,
  // INVALID_ARGUMENT where it is refused; then nothing changes.
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> LoadVersion(const PolicyVersion& version);

  // Each NOT_FOUND for a policy or version that is not served, and then nothing changes.

  // Drops a version, and keeps it out of reloads until LoadVersion names it. FAILED_PRECONDITION
  // while an operator's setting points at it.
  absl::Status Unload(const PolicyVersion& version);

  // The default; 0 makes it the highest version, now and later. Returns what it is now.
  absl::StatusOr<int64_t> SetDefault(const std::string& policy, int64_t version);

  // INVALID_ARGUMENT unless the label is plain.
  absl::Status SetLabel(const PolicyVersion& version, const std::string& label);
  absl::Status RemoveLabel(const std::string& policy, const std::string& label);

  // How new sessions that name no version are divided (none: to the default), and which version
  // shadows the others (0: none). INVALID_ARGUMENT unless every share is in [0, 100], no version
  // comes twice and they add up to 100; FAILED_PRECONDITION for a shadow whose observations or
  // actions are not those of the versions it would shadow.
  absl::Status SetTraffic(const std::string& policy, std::vector<TrafficShare> shares,
                          int64_t shadow_version);

  // Stops or resumes learning in every version of one policy, or of all that are served (empty).
  // Once a pause has returned, their shared heads stand still.
  absl::Status SetLearningPaused(const std::string& policy, bool paused);

 private:
  // A version's file when it was last read.
  struct KnownFile {
    FileStamp stamp;
    absl::Status status;  // why it was refused
  };

  PolicyRegistry(std::string directory, std::string settings_path, NewObserver new_observer)
      : directory_(std::move(directory)),
        settings_path_(std::move(settings_path)),
        new_observer_(std::move(new_observer)) {}

  void Publish(PolicyCatalog catalog) ABSL_LOCKS_EXCLUDED(mutex_);

  // Lets hold what can of the settings. Returns what waits.
  std::vector<std::string> ApplySettings(PolicyCatalog* catalog) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  // Writes the settings down, where there is a file for them.
  absl::Status Save(const Settings& settings) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  // Applies `change` to what is set for the policy, writes it down and lets it hold.
  absl::Status Change(
      const std::string& policy,
      absl::FunctionRef<absl::Status(const CatalogPolicy& policy, PolicySettings* settings)>
          change);

  absl::StatusOr<std::shared_ptr<const ServedPolicy>> Read(const PolicyVersion& version)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  void LoadChanged(const std::vector<PolicyVersion>& versions, PolicyCatalog* catalog,
                   ReloadReport* report) ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);
  void DropGone(PolicyCatalog* catalog, ReloadReport* report)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(change_mutex_);

  const std::string directory_;
  const std::string settings_path_;  // empty: nothing is written
  const NewObserver new_observer_;

  absl::Mutex change_mutex_;  // held for a whole change, taken before mutex_
  std::map<PolicyVersion, KnownFile> files_ ABSL_GUARDED_BY(change_mutex_);
  // What operators have set, also what waits; the catalog has what holds.
  Settings settings_ ABSL_GUARDED_BY(change_mutex_);
  // By policy: one for all its versions, so that a pause misses none, whenever it is read.
  std::map<std::string, std::shared_ptr<LearningSwitch>> learning_ ABSL_GUARDED_BY(change_mutex_);

  mutable absl::Mutex mutex_;  // held for a copy of the pointer
  std::shared_ptr<const PolicyCatalog> catalog_ ABSL_GUARDED_BY(mutex_) =
      std::make_shared<const PolicyCatalog>();
};

}  // namespace spikeserve

#endif  // SERVER_POLICIES_POLICY_REGISTRY_H_
