#include "server/admin/audit.h"

#include <utility>

#include "absl/time/clock.h"
#include "nlohmann/json.hpp"
#include "proto/json.h"
#include "server/admin/traffic.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

// What a line needs beside the request and the states: names, and the message of an error.
constexpr size_t kNamesBytes = 4096;
// The longest request that a line has as a whole.
constexpr size_t kRequestBytes = 16 << 10;
// By how much a state may grow, and its text when it is escaped.
constexpr size_t kEscaped = 2;

// Returns a request as JSON, or its beginning if it is long.
std::string RequestText(const google::protobuf::Message& message) {
  std::string text = JsonText(MessageToFields(message));
  if (text.size() <= kRequestBytes) return text;
  const ordered_json shortened = {{"begins", text.substr(0, kRequestBytes / 4)},
                                  {"bytes", text.size()}};
  return shortened.dump(-1, ' ', /*ensure_ascii=*/true, ordered_json::error_handler_t::replace);
}

// Returns the policy that a request names, or an empty string.
std::string PolicyOf(const google::protobuf::Message& request) {
  for (const char* name : {"policy", "model_name"}) {
    const auto* field = request.GetDescriptor()->FindFieldByName(name);
    if (field != nullptr) return request.GetReflection()->GetString(request, field);
  }
  return "";
}

ordered_json PolicyState(const PolicyCatalog& catalog, const std::string& name) {
  ordered_json state = MessageToFields(TrafficOf(catalog, name));
  if (const auto policy = catalog.FindPolicy(name); policy.ok()) {
    state["learning_paused"] = (*policy)->versions.begin()->second->learning->paused();
  }
  return state;
}

}  // namespace

std::string Audit::StateOf(const google::protobuf::Message& request,
                           const std::string& tenant) const {
  const auto catalog = registry_->catalog();
  const std::string policy = PolicyOf(request);
  if (!policy.empty()) return PolicyState(*catalog, policy).dump();
  ordered_json state = {{"draining", store_->draining()}, {"policies", ordered_json::object()}};
  const auto holds = registry_->settings().holds().Get();
  for (const SessionHold& hold : *holds) {
    if (hold.selection.tenant.value_or(tenant) != tenant) continue;
    state["holds"].push_back(ordered_json(HoldJson(hold)));
  }
  for (const auto& [name, served] : catalog->policies()) {
    state["policies"][name] = PolicyState(*catalog, name);
  }
  return state.dump();
}

absl::Status Audit::RunAndRecord(const Method& method, const CallContext& context,
                                 const google::protobuf::Message& request,
                                 absl::FunctionRef<absl::Status()> change) const {
  AuditEntry entry = {.time = absl::Now(),
                      .action = method.name,
                      .token = context.caller->name(),
                      .tenant = context.caller->tenant()->name(),
                      .peer = context.peer,
                      .policy = PolicyOf(request),
                      .request = RequestText(request)};
  // An agent's call changes nothing that is served.
  const bool changes = method.access == Access::kOperatorOnly;
  entry.is_operators = changes;
  size_t reserved = 0;
  if (changes) {
    entry.before = StateOf(request, entry.tenant);
    reserved = kNamesBytes + kEscaped * (entry.request.size() + 2 * entry.before.size());
    if (auto room = log_->Reserve(reserved); !room.ok()) {
      if (!allow_unrecorded_) return room;
      reserved = 0;
    }
  }
  entry.outcome = change();
  if (changes) entry.after = StateOf(request, entry.tenant);
  auto outcome = entry.outcome;
  const auto recorded = log_->Record(std::move(entry), reserved);
  if (outcome.ok() && !allow_unrecorded_) outcome = recorded;
  return outcome;
}

void Audit::Record(const RolloutManager::Change& change) const {
  // A roll-out that has to end does so, even if that cannot be recorded; the log has the error.
  (void)log_->Record({.time = absl::Now(),
                      .action = change.action,
                      .policy = change.policy,
                      .request = ordered_json({{"reason", change.reason}}).dump(),
                      .before = PolicyState(*change.before, change.policy).dump(),
                      .after = PolicyState(*change.after, change.policy).dump()});
}

}  // namespace spikeserve
