// How a PolicyRegistry shares settings and promoted versions with other servers.
#include <algorithm>
#include <string>
#include <utility>

#include "absl/algorithm/container.h"
#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "server/base/log.h"
#include "server/policies/policy_registry.h"
#include "server/policies/policy_settings.h"
#include "server/policies/version_writer.h"

namespace spikeserve {
namespace {

// How often a change is tried while other servers change the settings, too.
constexpr int kMostAttempts = 20;

absl::Status CheckSha256(absl::string_view bytes, absl::string_view expected) {
  const std::string received = Sha256Of(bytes);
  if (received == expected) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("expected SHA-256 ", expected, ", received ", received));
}

}  // namespace

absl::Status PolicyRegistry::WithLatest(absl::FunctionRef<absl::Status()> attempt) {
  absl::Status status;
  for (int i = 0; i < kMostAttempts; ++i) {
    if (status = Refresh(); !status.ok()) return status;
    if (status = attempt(); !absl::IsAborted(status)) return status;
  }
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
    // The store is new, or has lost the settings.
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
  settings_ = *std::move(settings);
  revision_ = document.revision;
  if (auto status = SaveFile(settings_); !status.ok()) {
    LogError("shared settings not saved", {{"error", status.message()}});
  }
  FetchPromoted();
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

void PolicyRegistry::FetchPromoted() {
  for (const auto& [version, sha256] : settings_.promoted) {
    const std::string path = PolicyFilePath(options_.directory, version);
    absl::Status status;
    if (StampOf(path).size >= 0) {
      const auto found = ReadFile(path);
      if (found.ok()) status = Annotate(CheckSha256(*found, sha256), path);
    } else {
      const auto files = FetchFiles(sha256);
      status = Annotate(files.status(), path);
      if (status.ok()) status = WriteVersion(options_.directory, version, *files);
    }
    if (!status.ok()) {
      LogError("promoted version not taken over",
               {{"policy", version.policy}, {"error", status.message()}});
    }
  }
}

absl::StatusOr<VersionFiles> PolicyRegistry::FetchFiles(const std::string& sha256) {
  ASSIGN_OR_RETURN(auto policy, options_.shared->GetFile(sha256));
  RETURN_IF_ERROR(CheckSha256(policy, sha256));
  VersionFiles files = {.policy = std::move(policy), .signature = {}};
  auto signature = options_.shared->GetFile(SignaturePath(sha256));
  if (signature.ok()) {
    files.signature = *std::move(signature);
  } else if (!absl::IsNotFound(signature.status())) {
    return signature.status();
  }
  if (options_.signatures == nullptr) return files;
  auto status = options_.signatures->Verify(files);
  if (!status.ok()) return Annotate(status, "promoted version in the session store");
  return files;
}

absl::StatusOr<PolicyVersion> PolicyRegistry::ShareVersion(const std::string& name,
                                                           const VersionFiles& files,
                                                           bool make_default) {
  SPIKESERVE_DCHECK(shares_settings());
  const std::string sha256 = Sha256Of(files.policy);
  absl::MutexLock change(&change_mutex_);
  if (!files.signature.empty()) {
    RETURN_IF_ERROR(options_.shared->PutFile(SignaturePath(sha256), files.signature));
  }
  RETURN_IF_ERROR(options_.shared->PutFile(sha256, files.policy));
  absl::StatusOr<PolicyVersion> version;
  RETURN_IF_ERROR(WithLatest([&] {
    change_mutex_.AssertHeld();
    version = ShareOnce(name, sha256, make_default);
    return version.status();
  }));
  return version;
}

absl::StatusOr<PolicyVersion> PolicyRegistry::ShareOnce(const std::string& name,
                                                        const std::string& sha256,
                                                        bool make_default) {
  Settings settings = settings_;
  PolicyVersion version = {.policy = name, .version = NextVersion(options_.directory, name)};
  for (const auto& [known, ignored] : settings.promoted) {
    if (known.policy == name) version.version = std::max(version.version, known.version + 1);
  }
  settings.promoted[version] = sha256;
  if (make_default) {
    PolicySettings& changed = settings.policies[name];
    RETURN_IF_ERROR(CheckNoRollout(changed));
    changed.default_version = version.version;
    changed.default_follows_highest = false;
  }
  RETURN_IF_ERROR(Save(settings));
  // From here on as on every other server.
  if (auto status = Adopt({.revision = revision_, .json = ToJson(settings)}); !status.ok()) {
    return status;
  }
  if (auto served = catalog()->Find(name, version.version); !served.ok()) return served.status();
  return version;
}

}  // namespace spikeserve
