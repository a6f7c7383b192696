#include "server/policies/shared_files.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

// Servers take changes over, and say so, every 250 milliseconds.
constexpr absl::Duration kLoadingPause = absl::Milliseconds(100);
constexpr int kLoadingPauses = 10;

std::string NameOf(const ServedPolicy& served) {
  return absl::StrCat(served.name, "@", served.version);
}

}  // namespace

absl::Status SharedFiles::Follow(const std::vector<std::string>& alive) {
  auto catalog = registry_.catalog();
  ASSIGN_OR_RETURN(const auto revision, shared_.FilesRevision());
  const bool is_same_fleet = [&] {
    absl::MutexLock lock(&mutex_);
    return std::exchange(alive_, alive) == alive;
  }();
  if (catalog == catalog_ && is_same_fleet && revision == revision_) return absl::OkStatus();
  catalog_ = nullptr;  // until the comparison has succeeded
  std::vector<SharedSettings::VersionFile> files;
  for (const auto& [name, policy] : catalog->policies()) {
    for (const auto& [version, served] : policy.versions) {
      files.push_back({.version = NameOf(*served), .sha256 = served->sha256});
    }
  }
  ASSIGN_OR_RETURN(auto compared, shared_.CompareFiles(files, alive));
  catalog_ = std::move(catalog);
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

absl::Status SharedFiles::CheckServedByAll(const PolicyVersion& version) const {
  const auto catalog = registry_.catalog();
  const auto served = catalog->Find(version.policy, version.version);
  if (!served.ok()) return absl::OkStatus();
  const SharedSettings::VersionFile file = {.version = NameOf(**served),
                                            .sha256 = (*served)->sha256};
  for (int i = 0;; ++i) {
    const std::vector<std::string> alive = [this] {
      absl::MutexLock lock(&mutex_);
      return alive_;
    }();
    ASSIGN_OR_RETURN(const auto without, shared_.ServersWithout(file, alive));
    if (without.empty()) return absl::OkStatus();
    if (i == kLoadingPauses) {
      return absl::FailedPreconditionError(
          absl::StrCat("version: expected one that every live server serves, received ",
                       version.version, ", which ", without.size(), " of ", alive.size(),
                       " lack, or have another file of: ", absl::StrJoin(without, ", "),
                       "; load it there, as by spikectl admin load --server=A,B,C"));
    }
    absl::SleepFor(kLoadingPause);
  }
}

absl::Status SharedFiles::Check(const ServedPolicy& served) const {
  absl::MutexLock lock(&mutex_);
  if (different_.empty() || !different_.contains(NameOf(served))) return absl::OkStatus();
  return absl::UnavailableError(absl::StrCat(
      "version: expected one whose file is that of the other servers, received ", served.version,
      " of ", served.name, ", whose file is another one here; try another server"));
}

}  // namespace spikeserve
