// How a PolicyRegistry shares settings with other servers.
#include <string>
#include <utility>

#include "absl/algorithm/container.h"
#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/policies/policy_registry.h"
#include "server/policies/policy_settings.h"
#include "server/policies/version_writer.h"

namespace spikeserve {
namespace {

// How often a change is tried while other servers change the settings, too.
constexpr int kMostAttempts = 20;

}  // namespace

absl::Status PolicyRegistry::WithLatest(absl::FunctionRef<absl::Status()> attempt,
                                        const Span* call) {
  absl::MutexLock change(&change_mutex_);
  call_ = call;
  absl::Status status = absl::AbortedError("");
  for (int i = 0; i < kMostAttempts && absl::IsAborted(status); ++i) {
    status = Refresh();
    if (status.ok()) status = attempt();
  }
  call_ = nullptr;
  if (!absl::IsAborted(status)) return status;
  return absl::UnavailableError(absl::StrCat(status.message(), "; try again"));
}

absl::Status PolicyRegistry::Follow() {
  absl::MutexLock change(&change_mutex_);
  return Refresh();
}

absl::Status PolicyRegistry::Refresh() {
  if (!shares_settings()) return absl::OkStatus();
  auto document = options_.shared->Read();
  for (int i = 0; document.ok() && document->revision == 0; ++i) {
    if (i == kMostAttempts) {
      return absl::UnavailableError("settings: the store has no settings and takes none");
    }
    // The store is new, or has lost the settings, and the files that belong to them.
    for (const auto& [version, sha256] : settings_.promoted) {
      auto files = ReadVersionFiles(PolicyFilePath(options_.directory, version),
                                    /*with_signature=*/true);
      if (!files.ok()) continue;
      files->pushed = IsPushed(options_.directory, version);
      RETURN_IF_ERROR(PutFiles(version, *files, sha256));
    }
    const SharedSettings::Document first = {.revision = 1, .json = ToJson(settings_)};
    const auto status = options_.shared->Write(first);
    if (status.ok()) {
      // Operators must hear of it: what they had set may be lost.
      LogWarning("the store has no settings; it gets those of this server",
                 {{"settings", revision_ > 0                    ? "that the servers had shared"
                               : options_.settings_path.empty() ? "defaults"
                                                                : options_.settings_path}});
      document = first;
      revision_ = 1;
    } else if (absl::IsAborted(status)) {
      document = options_.shared->Read();  // another server was faster
    } else {
      return status;
    }
  }
  if (!document.ok()) return document.status();
  if (document->revision != revision_) {
    RETURN_IF_ERROR(Adopt(*document));
  }
  joined_.store(true, std::memory_order_release);
  return absl::OkStatus();
}

absl::Status PolicyRegistry::Adopt(const SharedSettings::Document& document) {
  auto settings = ParseSettings(document.json);
  if (!settings.ok()) return Annotate(settings.status(), "shared settings");
  const Settings before = std::exchange(settings_, *std::move(settings));
  revision_ = document.revision;
  holds_.Set(settings_.holds);
  if (auto status = SaveFile(settings_); !status.ok()) {
    LogError("shared settings not saved", {{"error", status.message()}});
  }
  FetchStored(before);
  ASSIGN_OR_RETURN(auto folders, ListPolicyFolders(options_.directory));
  ReloadReport report;
  PolicyCatalog catalog = *this->catalog();
  for (const PolicyVersion& version : settings_.unloaded) {
    const auto policy = catalog.policies().find(version.policy);
    if (policy == catalog.policies().end()) continue;
    policy->second.versions.erase(version.version);
    files_.erase(version);
    if (policy->second.versions.empty()) catalog.policies().erase(policy);
  }
  LoadChanged(folders.versions, &catalog, &report);
  UnloadRemoved(&catalog, &report);
  auto waiting = ApplySettings(&catalog);
  for (const std::string& line : waiting) {
    if (!absl::c_linear_search(waiting_, line)) {
      LogWarning("a shared setting waits for its version", {{"setting", line}});
    }
  }
  waiting_ = std::move(waiting);
  SwitchLearning();
  Publish(std::move(catalog));
  return absl::OkStatus();
}

}  // namespace spikeserve
