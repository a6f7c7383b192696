#include "server/policies/shared_versions.h"

#include <cstddef>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"

namespace spikeserve {
namespace {

absl::Status CheckSha256(absl::string_view bytes, absl::string_view expected) {
  const std::string received = Sha256Of(bytes);
  if (received == expected) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("expected SHA-256 ", expected, ", received ", received));
}

// The name of the shared file of a pushed version, which holds the length of the signature in
// decimal, a space, the signature, and the policy file.
std::string PushedName(const PolicyVersion& version, const std::string& sha256) {
  return absl::StrCat(sha256, ".", version.policy, ".", version.version);
}

absl::StatusOr<VersionFiles> ParsePushed(absl::string_view bytes) {
  const std::pair<absl::string_view, absl::string_view> parts =
      absl::StrSplit(bytes, absl::MaxSplits(' ', 1));
  size_t length = 0;
  if (!absl::SimpleAtoi(parts.first, &length) || length > parts.second.size()) {
    return absl::InvalidArgumentError("expected a signature and a policy, received other bytes");
  }
  return VersionFiles{.policy = std::string(parts.second.substr(length)),
                      .signature = std::string(parts.second.substr(0, length)),
                      .pushed = true};
}

}  // namespace

absl::Status SharedVersions::Put(const PolicyVersion& version, const VersionFiles& files,
                                 const std::string& sha256) const {
  if (files.pushed) {
    return shared_->PutFile(
        PushedName(version, sha256),
        absl::StrCat(files.signature.size(), " ", files.signature, files.policy));
  }
  if (!files.signature.empty()) {
    RETURN_IF_ERROR(shared_->PutFile(SignaturePath(sha256), files.signature));
  }
  return shared_->PutFile(sha256, files.policy);
}

absl::Status SharedVersions::PutAll(const Settings& settings) const {
  for (const auto& [version, sha256] : settings.promoted) {
    auto files = folder_.Read(version);
    if (!files.ok()) continue;
    files->pushed = folder_.IsPushed(version);
    RETURN_IF_ERROR(Put(version, *files, sha256));
  }
  return absl::OkStatus();
}

void SharedVersions::Remove(const PolicyVersion& version, const std::string& sha256,
                            bool is_used) const {
  if (shared_ == nullptr || sha256.empty()) return;
  shared_->RemoveFile(PushedName(version, sha256)).IgnoreError();
  if (is_used) return;
  shared_->RemoveFile(sha256).IgnoreError();
  shared_->RemoveFile(SignaturePath(sha256)).IgnoreError();
}

std::vector<std::string> SharedVersions::Fetch(const Settings& before, const Settings& settings,
                                               const PolicyCatalog& catalog) const {
  std::vector<std::string> missing;
  for (const auto& [version, sha256] : settings.promoted) {
    const auto served = catalog.Find(version.policy, version.version);
    if (served.ok() && (*served)->sha256 == sha256) continue;
    const auto status = FetchOne(version, sha256);
    if (!status.ok()) missing.emplace_back(status.message());
  }
  for (const auto& [version, sha256] : before.promoted) {
    if (settings.promoted.contains(version) || !settings.unloaded.contains(version)) continue;
    folder_.Remove(version).status().IgnoreError();  // it is not served
    // The server that has removed it may not have come to that.
    shared_->RemoveFile(PushedName(version, sha256)).IgnoreError();
  }
  return missing;
}

absl::Status SharedVersions::FetchOne(const PolicyVersion& version,
                                      const std::string& sha256) const {
  const std::string path = folder_.PathOf(version);
  if (!folder_.Has(version)) {
    const auto files = Get(version, sha256);
    if (!files.ok()) return Annotate(files.status(), path);
    const auto written = folder_.Write(version, *files);
    // A server with the same folder may have been faster.
    if (written.ok() || !folder_.Has(version)) return written;
  }
  const auto found = ReadFile(path);
  return found.ok() ? Annotate(CheckSha256(*found, sha256), path) : absl::OkStatus();
}

absl::StatusOr<VersionFiles> SharedVersions::Get(const PolicyVersion& version,
                                                 const std::string& sha256) const {
  VersionFiles files;
  if (auto pushed = shared_->GetFile(PushedName(version, sha256)); pushed.ok()) {
    ASSIGN_OR_RETURN(files, ParsePushed(*pushed));
  } else if (!absl::IsNotFound(pushed.status())) {
    return pushed.status();
  } else {
    ASSIGN_OR_RETURN(files.policy, shared_->GetFile(sha256));
    auto signature = shared_->GetFile(SignaturePath(sha256));
    if (!signature.ok() && !absl::IsNotFound(signature.status())) return signature.status();
    files.signature = std::move(signature).value_or("");
  }
  RETURN_IF_ERROR(CheckSha256(files.policy, sha256));
  RETURN_IF_ERROR(
      Annotate(folder_.Verify(version, files), "promoted version in the session store"));
  return files;
}

}  // namespace spikeserve
