#include "server/admin/audit.h"

#include <utility>

#include "absl/time/clock.h"
#include "nlohmann/json.hpp"
#include "proto/json.h"
#include "server/admin/traffic.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

Json MessageJson(const google::protobuf::Message& message) {
  const auto text = MessageToJson(message);
  return text.ok() ? Json::parse(*text, nullptr, /*allow_exceptions=*/false) : Json();
}

// Returns the policy that a request names, or an empty string.
std::string PolicyOf(const google::protobuf::Message& request) {
  for (const char* name : {"policy", "model_name"}) {
    const auto* field = request.GetDescriptor()->FindFieldByName(name);
    if (field != nullptr) return request.GetReflection()->GetString(request, field);
  }
  return "";
}

Json PolicyState(const PolicyCatalog& catalog, const std::string& name) {
  Json state = MessageJson(TrafficOf(catalog, name));
  if (const auto policy = catalog.FindPolicy(name); policy.ok()) {
    state["learning_paused"] = (*policy)->versions.begin()->second->learning->paused();
  }
  return state;
}

}  // namespace

std::string Audit::StateBefore(const google::protobuf::Message& request) const {
  const auto catalog = registry_->catalog();
  const std::string policy = PolicyOf(request);
  if (!policy.empty()) return PolicyState(*catalog, policy).dump();
  Json state = {{"draining", store_->draining()}, {"policies", Json::object()}};
  for (const auto& [name, served] : catalog->policies()) {
    state["policies"][name] = PolicyState(*catalog, name);
  }
  return state.dump();
}

void Audit::Record(Method method, const Credential& caller, const Peer& peer,
                   const google::protobuf::Message& request, std::string before,
                   const absl::Status& outcome) const {
  log_->Record({.time = absl::Now(),
                .action = std::string(GetMethodInfo(method).name),
                .token = caller.name(),
                .tenant = caller.tenant()->name(),
                .peer = peer,
                .policy = PolicyOf(request),
                .request = MessageJson(request).dump(),
                .outcome = outcome,
                .before = std::move(before),
                .after = StateBefore(request)});
}

void Audit::Record(const RolloutManager::Change& change) const {
  log_->Record({.time = absl::Now(),
                .action = change.action,
                .policy = change.policy,
                .request = Json({{"reason", change.reason}}).dump(),
                .before = PolicyState(*change.before, change.policy).dump(),
                .after = PolicyState(*change.after, change.policy).dump()});
}

}  // namespace spikeserve
