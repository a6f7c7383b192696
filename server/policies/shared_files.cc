#include "server/policies/shared_files.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

std::string NameOf(const ServedPolicy& served) {
  return absl::StrCat(served.name, "@", served.version);
}

}  // namespace

absl::Status SharedFiles::Follow(const std::vector<std::string>& alive) {
  auto catalog = registry_.catalog();
  ASSIGN_OR_RETURN(const auto revision, shared_.FilesRevision());
  if (catalog == catalog_ && alive == alive_ && revision == revision_) return absl::OkStatus();
  std::vector<SharedSettings::VersionFile> files;
  for (const auto& [name, policy] : catalog->policies()) {
    for (const auto& [version, served] : policy.versions) {
      files.push_back({.version = NameOf(*served), .sha256 = served->sha256});
    }
  }
  ASSIGN_OR_RETURN(auto compared, shared_.CompareFiles(files, alive));
  catalog_ = std::move(catalog);
  alive_ = alive;
  revision_ = compared.revision;
  std::set<std::string> different(compared.different.begin(), compared.different.end());
  absl::MutexLock lock(&mutex_);
  for (const std::string& version : different) {
    if (different_.contains(version)) continue;
    LogError("other servers have another file of a version; opens no stored sessions on it",
             {{"version", version}});
  }
  different_ = std::move(different);
  return absl::OkStatus();
}

absl::Status SharedFiles::Check(const ServedPolicy& served) const {
  absl::MutexLock lock(&mutex_);
  if (different_.empty() || !different_.contains(NameOf(served))) return absl::OkStatus();
  return absl::UnavailableError(absl::StrCat(
      "version: expected one whose file is that of the other servers, received ", served.version,
      " of ", served.name, ", whose file is another one here; try another server"));
}

}  // namespace spikeserve
