#include "server/admin/admin_handler.h"

#include <algorithm>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/admin/session_info.h"
#include "server/admin/traffic.h"
#include "server/messages/convert.h"

namespace spikeserve {
namespace {

constexpr int32_t kDefaultPageSize = 100;
constexpr int32_t kLargestPageSize = 1000;

template <typename Proto>
void ToProto(const std::vector<PolicyVersion>& versions, Proto* list) {
  for (const PolicyVersion& version : versions) {
    auto* item = list->Add();
    item->set_policy(version.policy);
    item->set_version(version.version);
  }
}

template <typename Proto>
std::vector<TrafficShare> SharesFromProto(const Proto& list) {
  std::vector<TrafficShare> shares;
  for (const v1::TrafficShare& share : list) {
    shares.push_back({.version = share.version(), .percent = share.percent()});
  }
  return shares;
}

void ToProto(const AuditEntry& entry, v1::HistoryEntry* proto) {
  proto->set_time(absl::ToDoubleSeconds(entry.time - absl::UnixEpoch()));
  proto->set_action(entry.action);
  proto->set_token(entry.token);
  proto->set_tenant(entry.tenant);
  proto->set_certificate(entry.peer.certificate);
  proto->set_address(entry.peer.address);
  proto->set_policy(entry.policy);
  proto->set_request(entry.request);
  proto->set_code(static_cast<int32_t>(entry.outcome.code()));
  proto->set_message(std::string(entry.outcome.message()));
  proto->set_before(entry.before);
  proto->set_after(entry.after);
}

absl::Status SetShares(const CatalogPolicy& served, const std::string& policy,
                       const std::vector<TrafficShare>& shares, int64_t shadow_version,
                       PolicySettings* settings) {
  RETURN_IF_ERROR(CheckNoRollout(*settings));
  RETURN_IF_ERROR(served.CheckTraffic(policy, shares, shadow_version));
  settings->shares = shares;
  return absl::OkStatus();
}

// Lists the `limit` wanted sessions that need help most.
void ListByNeed(SessionStore& store, absl::FunctionRef<bool(const SessionEntry&)> wanted,
                size_t limit, v1::ListSessionsResponse* response) {
  std::vector<std::pair<double, ListedSession>> neediest;  // a heap, the least need at its front
  const auto is_before = [](const auto& a, const auto& b) {
    return a.first != b.first ? a.first > b.first : a.second.id < b.second.id;
  };
  store.ForEach(wanted, [&](const ListedSession& listed) {
    Help help;
    {
      absl::MutexLock lock(&listed.entry->mutex);
      help = listed.entry->agent.NeedsHelp();
    }
    if (!help.is_needed()) return;
    neediest.emplace_back(help.score(), listed);
    std::push_heap(neediest.begin(), neediest.end(), is_before);
    if (neediest.size() <= limit) return;
    std::pop_heap(neediest.begin(), neediest.end(), is_before);
    neediest.pop_back();
  });
  std::sort_heap(neediest.begin(), neediest.end(), is_before);
  for (const auto& [score, listed] : neediest) ToProto(listed, response->add_sessions());
}

// Changes the settings of the policy that `request` names.
template <typename Request, typename Response>
absl::Status ChangeSettings(
    PolicyRegistry& registry, const Request& request, Response* response,
    absl::FunctionRef<absl::Status(const CatalogPolicy& policy, PolicySettings* settings)> change) {
  return ChangeTraffic(registry, request.policy(), response->mutable_traffic(),
                       [&] { return registry.Change(request.policy(), change); });
}

}  // namespace

absl::Status AdminHandler::LoadPolicy(CallContext& context, const v1::LoadPolicyRequest& request,
                                      v1::LoadPolicyResponse* response) const {
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> served;
  const auto load = [&] {
    served =
        parts_.registry->LoadVersion({.policy = request.policy(), .version = request.version()},
                                     request.make_default(), &context.span);
    return served.status();
  };
  RETURN_IF_ERROR(
      ChangeTraffic(*parts_.registry, request.policy(), response->mutable_traffic(), load));
  const auto catalog = parts_.registry->catalog();
  const auto policy = catalog->FindPolicy(request.policy());
  if (!policy.ok()) return policy.status();  // another call has unloaded it since
  *response->mutable_policy() = ToProto(**policy, **served);
  return absl::OkStatus();
}

absl::Status AdminHandler::UnloadPolicy(CallContext& /*context*/,
                                        const v1::UnloadPolicyRequest& request,
                                        v1::UnloadPolicyResponse* response) const {
  return ChangeTraffic(*parts_.registry, request.policy(), response->mutable_traffic(), [&] {
    return parts_.registry->Unload({.policy = request.policy(), .version = request.version()});
  });
}

absl::Status AdminHandler::ReloadPolicies(CallContext& context,
                                          const v1::ReloadPoliciesRequest& /*request*/,
                                          v1::ReloadPoliciesResponse* response) const {
  ASSIGN_OR_RETURN(const auto report, parts_.registry->Reload(&context.span));
  ToProto(report.loaded, response->mutable_loaded());
  ToProto(report.unloaded, response->mutable_unloaded());
  for (const absl::Status& refused : report.refused) {
    response->add_refused(std::string(refused.message()));
  }
  for (const std::string& setting : report.waiting) response->add_waiting(setting);
  return absl::OkStatus();
}

absl::Status AdminHandler::SetDefaultVersion(CallContext& /*context*/,
                                             const v1::SetDefaultVersionRequest& request,
                                             v1::SetDefaultVersionResponse* response) const {
  return ChangeTraffic(*parts_.registry, request.policy(), response->mutable_traffic(), [&] {
    const auto version = parts_.registry->SetDefault(request.policy(), request.version());
    if (version.ok()) response->set_version(*version);
    return version.status();
  });
}

absl::Status AdminHandler::SetLabel(CallContext& /*context*/, const v1::SetLabelRequest& request,
                                    v1::SetLabelResponse* response) const {
  if (!IsPlainName(request.label())) {
    return InvalidArgument(
        "label", absl::StrCat("at most ", kLongestName, " letters, digits, '.', '-', '_'"),
        Quoted(request.label()));
  }
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    RETURN_IF_ERROR(served.CheckVersion({request.policy(), request.version()}));
    settings->labels[request.label()] = request.version();
    return absl::OkStatus();
  };
  return ChangeSettings(*parts_.registry, request, response, change);
}

absl::Status AdminHandler::RemoveLabel(CallContext& /*context*/,
                                       const v1::RemoveLabelRequest& request,
                                       v1::RemoveLabelResponse* response) const {
  const auto change = [&](const CatalogPolicy& /*served*/, PolicySettings* settings) {
    if (settings->labels.erase(request.label()) == 1) return absl::OkStatus();
    return absl::NotFoundError(absl::StrCat("label: expected one of policy ", request.policy(),
                                            ", received ", Quoted(request.label())));
  };
  return ChangeSettings(*parts_.registry, request, response, change);
}

absl::Status AdminHandler::SetTraffic(CallContext& /*context*/,
                                      const v1::SetTrafficRequest& request,
                                      v1::SetTrafficResponse* response) const {
  const auto shares = SharesFromProto(request.shares());
  RETURN_IF_ERROR(CheckServedByAll(request.policy(), shares));
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    settings->shadow_version = request.shadow_version();
    return SetShares(served, request.policy(), shares, request.shadow_version(), settings);
  };
  return ChangeSettings(*parts_.registry, request, response, change);
}

absl::Status AdminHandler::SetTrafficShares(CallContext& /*context*/,
                                            const v1::SetTrafficSharesRequest& request,
                                            v1::SetTrafficSharesResponse* response) const {
  const auto shares = SharesFromProto(request.shares());
  RETURN_IF_ERROR(CheckServedByAll(request.policy(), shares));
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    return SetShares(served, request.policy(), shares, served.settings.shadow_version, settings);
  };
  return ChangeSettings(*parts_.registry, request, response, change);
}

absl::Status AdminHandler::CheckServedByAll(const std::string& policy,
                                            const std::vector<TrafficShare>& shares) const {
  if (parts_.files == nullptr) return absl::OkStatus();
  for (const TrafficShare& share : shares) {
    if (share.percent > 0) {
      RETURN_IF_ERROR(parts_.files->CheckServedByAll({policy, share.version}));
    }
  }
  return absl::OkStatus();
}

absl::Status AdminHandler::SetShadow(CallContext& /*context*/, const v1::SetShadowRequest& request,
                                     v1::SetShadowResponse* response) const {
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    settings->shadow_version = request.shadow_version();
    return served.CheckShadow(request.policy(), served.settings.shares, request.shadow_version());
  };
  return ChangeSettings(*parts_.registry, request, response, change);
}

absl::Status AdminHandler::ListHistory(CallContext& context, const v1::ListHistoryRequest& request,
                                       v1::ListHistoryResponse* response) const {
  if (request.limit() < 0 || request.limit() > kLargestPageSize) {
    return InvalidArgument("limit", absl::StrCat("0 to ", kLargestPageSize), request.limit());
  }
  const int32_t limit = request.limit() == 0 ? kDefaultPageSize : request.limit();
  const auto wanted = [&](const AuditEntry& entry) {
    const bool is_of_server = entry.peer.address.empty();
    return (is_of_server || context.caller->CanRead(entry.tenant)) &&
           (request.policy().empty() || request.policy() == entry.policy);
  };
  for (const AuditEntry& entry : parts_.history->Last(wanted, static_cast<size_t>(limit))) {
    ToProto(entry, response->add_entries());
  }
  return absl::OkStatus();
}

absl::Status AdminHandler::Drain(CallContext& /*context*/, const v1::DrainRequest& request,
                                 v1::DrainResponse* response) const {
  parts_.store->SetDraining(!request.cancel());
  parts_.on_draining(!request.cancel());
  response->set_open_sessions(parts_.store->size());
  return absl::OkStatus();
}

absl::Status AdminHandler::ListSessions(CallContext& context,
                                        const v1::ListSessionsRequest& request,
                                        v1::ListSessionsResponse* response) const {
  if (request.page_size() < 0 || request.page_size() > kLargestPageSize) {
    return InvalidArgument("page_size", absl::StrCat("0 to ", kLargestPageSize),
                           request.page_size());
  }
  int64_t open = 0;
  int64_t open_stored = 0;
  const auto wanted = [&](const SessionEntry& entry) {
    if (!context.caller->CanRead(entry.tenant)) return false;
    ++open;
    if (entry.journal != nullptr) ++open_stored;
    return (request.policy().empty() || request.policy() == entry.served->name) &&
           (request.version() == 0 || request.version() == entry.served->version);
  };
  const auto size =
      static_cast<size_t>(request.page_size() == 0 ? kDefaultPageSize : request.page_size());
  if (request.by_need()) {
    if (!request.page_token().empty()) {
      return InvalidArgument("page_token", "none with by_need", Quoted(request.page_token()));
    }
    ListByNeed(*parts_.store, wanted, size, response);
  } else {
    // A page token is the id of the last session of the page before, so pages neither skip nor
    // repeat a session while others open and close.
    const auto sessions = parts_.store->ListAfter(request.page_token(), size + 1, wanted);
    for (size_t i = 0; i < std::min(size, sessions.size()); ++i) {
      ToProto(sessions[i], response->add_sessions());
    }
    if (sessions.size() > size) response->set_next_page_token(sessions[size - 1].id);
  }
  response->set_open_sessions(open);
  response->set_open_stored_sessions(open_stored);
  const auto stored = parts_.journals == nullptr ? std::nullopt : parts_.journals->StoredSessions();
  if (stored.has_value() && context.caller->CanReadAll()) {
    response->set_stored_sessions(*stored);
  }
  response->set_replica(parts_.replicas->self());
  return absl::OkStatus();
}

}  // namespace spikeserve
