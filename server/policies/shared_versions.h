// The files of versions that were promoted from a learned head or pushed, as servers that share
// settings keep them in the store: of a promoted version under its SHA-256, with its signature
// beside it; of a pushed version, whose signature is for its name and number, as one file under all
// three.
//
// Stateless; thread-safe.
#pragma once

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/policies/policy_catalog.h"
#include "server/policies/policy_folder.h"
#include "server/policies/policy_settings.h"
#include "server/policies/shared_settings.h"

namespace spikeserve {

class SharedVersions {
 public:
  // Both must outlive the object. `shared`: null if this server shares nothing; then only Remove()
  // may be called, which does nothing.
  SharedVersions(SharedSettings* shared, const PolicyFolder* folder)
      : shared_(shared), folder_(*folder) {}

  absl::Status Put(const PolicyVersion& version, const VersionFiles& files,
                   const std::string& sha256) const;
  // Writes those that the folder has.
  absl::Status PutAll(const Settings& settings) const;

  // Removes the files of a version that the store has; `is_used`: another version has the same.
  void Remove(const PolicyVersion& version, const std::string& sha256, bool is_used) const;

  // Writes to the folder the files of the versions of the settings that it does not have, and
  // removes those of versions that another server has removed since the settings were `before`, in
  // the store, too, if they were pushed.
  // Returns an error for each version that it could not get.
  std::vector<std::string> Fetch(const Settings& before, const Settings& settings,
                                 const PolicyCatalog& catalog) const;

 private:
  // Returns INVALID_ARGUMENT if the files are not what they should be.
  absl::StatusOr<VersionFiles> Get(const PolicyVersion& version, const std::string& sha256) const;
  absl::Status FetchOne(const PolicyVersion& version, const std::string& sha256) const;

  SharedSettings* const shared_;
  const PolicyFolder& folder_;
};

}  // namespace spikeserve
