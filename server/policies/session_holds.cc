#include "server/policies/session_holds.h"

#include <utility>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/policies/rollout.h"

namespace spikeserve {
namespace {

constexpr size_t kMostLabels = 16;
constexpr size_t kMostSessions = 1000;
constexpr size_t kMostSelectionBytes = 64 << 10;

}  // namespace

bool SessionSelection::Covers(const Session& session) const {
  const SessionOptions& options = session.options;
  if (!policy.empty() && policy != options.policy) return false;
  if (version != 0 && version != options.version) return false;
  if (tenant.has_value() && *tenant != options.tenant) return false;
  for (const auto& [key, value] : labels) {
    const auto label = options.labels.find(key);
    if (label == options.labels.end() || label->second != value) return false;
  }
  return session_ids.empty() || absl::c_linear_search(session_ids, session.id);
}

absl::Status SessionSelection::Validate() const {
  const auto refuse = [](absl::string_view field, const auto& expected, const auto& received) {
    return absl::InvalidArgumentError(
        absl::StrCat("selection.", field, ": expected ", expected, ", received ", received));
  };
  if (version < 0) return refuse("version", "at least 0", version);
  if (version > 0 && policy.empty()) return refuse("policy", "a name, for a version", "none");
  if (labels.size() > kMostLabels) {
    return refuse("labels", absl::StrCat("at most ", kMostLabels), labels.size());
  }
  if (session_ids.size() > kMostSessions) {
    return refuse("session_ids", absl::StrCat("at most ", kMostSessions), session_ids.size());
  }
  size_t bytes = policy.size();
  for (const auto& [key, value] : labels) bytes += key.size() + value.size();
  for (const std::string& id : session_ids) bytes += id.size();
  if (bytes > kMostSelectionBytes) {
    return InvalidArgument("selection", absl::StrCat("at most ", kMostSelectionBytes, " bytes"),
                           bytes);
  }
  return absl::OkStatus();
}

nlohmann::json HoldJson(const SessionHold& hold) {
  const SessionSelection& selection = hold.selection;
  nlohmann::json json = {{"id", hold.hold.id}, {"reason", hold.hold.reason}, {"since", hold.since}};
  if (!selection.policy.empty()) json["policy"] = selection.policy;
  if (selection.version != 0) json["version"] = selection.version;
  if (selection.tenant.has_value()) json["tenant"] = *selection.tenant;
  if (!selection.labels.empty()) json["labels"] = selection.labels;
  if (!selection.session_ids.empty()) json["session_ids"] = selection.session_ids;
  return json;
}

absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, SessionHold* hold) {
  JsonObject object(field, json);
  object.Required("id", &hold->hold.id);
  object.Required("reason", &hold->hold.reason);
  object.Required("since", &hold->since);
  object.Optional("policy", &hold->selection.policy);
  object.Optional("version", &hold->selection.version, kFirstVersion);
  object.Optional("tenant", &hold->selection.tenant);
  object.Optional("labels", &hold->selection.labels);
  object.Optional("session_ids", &hold->selection.session_ids);
  return object.Finish();
}

void SessionHolds::Set(List holds) {
  auto next = std::make_shared<const List>(std::move(holds));
  absl::MutexLock lock(&mutex_);
  if (*next == *holds_) return;
  holds_.swap(next);
  revision_.fetch_add(1, std::memory_order_release);
}

std::shared_ptr<const SessionHolds::List> SessionHolds::Get() const {
  absl::MutexLock lock(&mutex_);
  return holds_;
}

std::shared_ptr<const Hold> SessionHolds::Find(const Session& session) const {
  const auto holds = Get();
  for (const SessionHold& hold : *holds) {
    if (hold.selection.Covers(session)) return {holds, &hold.hold};
  }
  return nullptr;
}

}  // namespace spikeserve
