#include <iterator>
#include <memory>
#include <set>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "server/admin/admin_handler.h"
#include "server/admin/traffic.h"
#include "server/base/log.h"
#include "server/policies/signature_bundle.h"

namespace spikeserve {
namespace {

constexpr size_t kPartBytes = size_t{1} << 20;  // of a file, in one answer

absl::StatusOr<NewVersion> FromProto(const v1::PushPolicyRequest& request) {
  if (request.version() < 0) {
    return InvalidArgument("version", "at least 0", request.version());
  }
  if (request.signature().size() > kMostBundleBytes) {
    return InvalidArgument("signature", absl::StrCat("at most ", kMostBundleBytes, " bytes"),
                           request.signature().size());
  }
  NewVersion added = {.policy = request.policy(),
                      .version = request.version(),
                      .files = {.policy = absl::StrJoin(request.data(), ""),
                                .signature = request.signature(),
                                .pushed = true},
                      .make_default = request.make_default()};
  if (const std::string sha256 = Sha256Of(added.files.policy); sha256 != request.sha256()) {
    return InvalidArgument("sha256", absl::StrCat("that of the data, ", sha256),
                           Quoted(request.sha256()));
  }
  return added;
}

// Returns the served version that has the file, and the number if one is named; null if none has.
std::shared_ptr<const ServedPolicy> FindSame(const PolicyCatalog& catalog, const NewVersion& added,
                                             const std::string& sha256) {
  const auto policy = catalog.policies().find(added.policy);
  if (policy == catalog.policies().end()) return nullptr;
  for (const auto& [number, served] : policy->second.versions) {
    if (served->sha256 == sha256 && (added.version == 0 || added.version == number)) return served;
  }
  return nullptr;
}

}  // namespace

absl::StatusOr<std::string> AdminHandler::TenantOf(const Credential& caller,
                                                   const std::string& named) {
  const std::string& tenant = named.empty() ? caller.tenant()->name() : named;
  if (caller.CanRead(tenant)) return tenant;
  return absl::PermissionDeniedError(
      absl::StrCat("tenant: expected that of the token, received ", Quoted(named)));
}

absl::StatusOr<PolicyVersion> AdminHandler::AddVersion(const std::string& tenant,
                                                       const NewVersion& added,
                                                       v1::TrafficChange* traffic) const {
  SharedFolder* const folder = parts_.folder;
  folder->Measure();
  const auto place = folder->Take(
      tenant, static_cast<int64_t>(added.files.policy.size() + added.files.signature.size()));
  if (place == nullptr) {
    return absl::ResourceExhaustedError(
        absl::StrCat("--max_policy_bytes: expected room for a version in the share of tenant ",
                     Quoted(tenant), ", which may have as many bytes in ", folder->directory(),
                     " as are free; remove versions that are not needed"));
  }
  absl::StatusOr<PolicyVersion> version;
  RETURN_IF_ERROR(ChangeTraffic(*parts_.registry, added.policy, traffic, [&] {
    version = parts_.registry->AddVersion(added);
    return version.status();
  }));
  folder->Keep(*place);
  return version;
}

v1::PushPolicyRequest WithoutData(const v1::PushPolicyRequest& request) {
  v1::PushPolicyRequest header;
  header.set_policy(request.policy());
  header.set_version(request.version());
  header.set_sha256(request.sha256());
  if (request.signature().size() <= kSignatureBytes) header.set_signature(request.signature());
  header.set_make_default(request.make_default());
  header.set_tenant(request.tenant());
  return header;
}

absl::Status AdminHandler::PushPolicy(CallContext& context, const v1::PushPolicyRequest& request,
                                      v1::PushPolicyResponse* response) const {
  ASSIGN_OR_RETURN(const auto tenant, TenantOf(*context.caller, request.tenant()));
  ASSIGN_OR_RETURN(const auto added, FromProto(request));
  if (const auto same = FindSame(*parts_.registry->catalog(), added, request.sha256());
      same != nullptr) {
    response->set_version(same->version);
    response->set_existed(true);
    return ChangeTraffic(*parts_.registry, added.policy, response->mutable_traffic(), [&] {
      return added.make_default ? parts_.registry->SetDefault(added.policy, same->version).status()
                                : absl::OkStatus();
    });
  }
  RETURN_IF_ERROR(
      parts_.registry->folder().CheckPushed({added.policy, added.version}, added.files));
  ASSIGN_OR_RETURN(const auto surplus, Surplus(added.policy));
  ASSIGN_OR_RETURN(const auto version, AddVersion(tenant, added, response->mutable_traffic()));
  response->set_version(version.version);
  for (const PolicyVersion& old : surplus) {
    if (auto status = Remove(old, tenant); status.ok()) {
      response->add_removed(old.version);
    } else {
      LogWarning("an old version is not removed", {{"error", status.message()}});
    }
  }
  return absl::OkStatus();
}

absl::StatusOr<std::vector<PolicyVersion>> AdminHandler::Surplus(const std::string& policy) const {
  const auto pushed = parts_.registry->folder().PushedVersions(policy);
  const int64_t count = std::ssize(pushed) + 1 - parts_.max_pushed;
  std::vector<PolicyVersion> surplus;
  if (count <= 0) return surplus;
  std::set<int64_t> used;
  parts_.store->ForEach(
      [&](const SessionEntry& entry) { return entry.served->name == policy; },
      [&](const ListedSession& session) { used.insert(session.entry->served->version); });
  const auto catalog = parts_.registry->catalog();
  const auto served = catalog->FindPolicy(policy);
  for (const PolicyVersion& version : pushed) {
    if (std::ssize(surplus) == count) break;
    const bool is_set = served.ok() && !(*served)->settings.DescribeUse(version.version).empty();
    if (!is_set && !used.contains(version.version)) surplus.push_back(version);
  }
  if (std::ssize(surplus) == count) return surplus;
  return absl::ResourceExhaustedError(
      absl::StrCat("--max_pushed_versions: expected fewer than ", parts_.max_pushed,
                   " versions of policy ", policy, " that settings or open sessions use, received ",
                   pushed.size(), " versions, of which ", surplus.size(), " are not used"));
}

absl::Status AdminHandler::Remove(const PolicyVersion& version, const std::string& tenant) const {
  const auto bytes = parts_.registry->RemoveStored(version);
  if (bytes.ok()) parts_.folder->Remove(tenant, *bytes);
  return bytes.status();
}

absl::Status AdminHandler::PullPolicy(CallContext& /*context*/,
                                      const v1::PullPolicyRequest& request,
                                      v1::PullPolicyResponse* response) const {
  ASSIGN_OR_RETURN(const auto served,
                   parts_.registry->catalog()->Find(request.policy(), request.version()));
  ASSIGN_OR_RETURN(const auto files,
                   parts_.registry->folder().ReadForRobot({served->name, served->version}));
  const int64_t size = std::ssize(files.policy);
  if (request.offset() < 0 || request.offset() > size) {
    return InvalidArgument("offset", absl::StrCat("0 to ", size), request.offset());
  }
  response->set_version(served->version);
  response->set_size(size);
  response->set_sha256(Sha256Of(files.policy));
  response->set_signature(files.signature);
  response->set_data(files.policy.substr(static_cast<size_t>(request.offset()), kPartBytes));
  return absl::OkStatus();
}

absl::Status AdminHandler::RemovePolicy(CallContext& context,
                                        const v1::RemovePolicyRequest& request,
                                        v1::RemovePolicyResponse* response) const {
  return ChangeTraffic(*parts_.registry, request.policy(), response->mutable_traffic(), [&] {
    return Remove({.policy = request.policy(), .version = request.version()},
                  context.caller->tenant()->name());
  });
}

}  // namespace spikeserve
