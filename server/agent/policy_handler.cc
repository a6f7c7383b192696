#include "server/agent/policy_handler.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "absl/algorithm/container.h"
#include "absl/container/inlined_vector.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "server/agent/act_together.h"
#include "server/agent/convert.h"
#include "server/agent/explain_convert.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

absl::Status CheckLabels(const google::protobuf::Map<std::string, std::string>& labels) {
  if (labels.size() > LabelLimits::kLabels) {
    return absl::InvalidArgumentError(absl::StrCat(
        "labels: expected at most ", LabelLimits::kLabels, ", received ", labels.size()));
  }
  for (const auto& [key, value] : labels) {
    const size_t longest = std::max(key.size(), value.size());
    if (longest > LabelLimits::kBytes) {
      return absl::InvalidArgumentError(absl::StrCat("labels: expected keys and values of at most ",
                                                     LabelLimits::kBytes,
                                                     " bytes, received one of ", longest));
    }
  }
  return absl::OkStatus();
}

absl::StatusOr<SessionOptions> OptionsFromProto(const v1::OpenSessionRequest& request,
                                                const ServedPolicy& served) {
  auto settings = RequestFromProto(request);
  if (!settings.ok()) return settings.status();
  auto options = ResolveSession(*std::move(settings), served);
  if (!options.ok()) return options.status();
  if (auto status = CheckLabels(request.labels()); !status.ok()) return status;
  options->labels.insert(request.labels().begin(), request.labels().end());
  return options;
}

// Chooses the version that a new session is opened on. Without a routing key, the session's id
// decides its share of the traffic.
absl::StatusOr<Route> ChooseRoute(const v1::OpenSessionRequest& request, const std::string& id,
                                  const PolicyCatalog& catalog) {
  const std::string& key = request.routing_key();
  if (key.size() > LabelLimits::kBytes) {
    return absl::InvalidArgumentError(absl::StrCat(
        "routing_key: expected at most ", LabelLimits::kBytes, " bytes, received ", key.size()));
  }
  return catalog.Choose({.policy = request.policy(),
                         .version = request.version(),
                         .label = request.version_label(),
                         .routing_key = key.empty() ? id : key});
}

void SetError(const absl::Status& status, v1::ActResult* result) {
  result->clear_response();
  result->set_code(static_cast<int>(status.code()));
  result->set_message(std::string(status.message()));
  if (const auto delay = RetryDelay(status)) {
    result->set_retry_after_seconds(absl::ToDoubleSeconds(*delay));
  }
}

}  // namespace

PolicyHandler::PolicyHandler(const PolicyRegistry* registry, SessionStore* store,
                             ShadowRunner* shadows, const Clock* clock, Recordings* recordings)
    : registry_(registry),
      store_(store),
      shadows_(shadows),
      clock_(clock),
      recordings_(recordings) {}

absl::Status PolicyHandler::ListPolicies(const v1::ListPoliciesRequest& /*request*/,
                                         v1::ListPoliciesResponse* response) const {
  const auto catalog = registry_->catalog();
  for (const auto& [name, policy] : catalog->policies()) {
    for (const auto& [version, served] : policy.versions) {
      *response->add_policies() = ToProto(policy, *served);
    }
  }
  return absl::OkStatus();
}

absl::Status PolicyHandler::OpenSession(const Credential& caller,
                                        const v1::OpenSessionRequest& request,
                                        v1::OpenSessionResponse* response) const {
  return OpenSessionAs(caller, "", request, response);
}

absl::Status PolicyHandler::OpenSessionAs(const Credential& caller, std::string session_id,
                                          const v1::OpenSessionRequest& request,
                                          v1::OpenSessionResponse* response) const {
  absl::StatusOr<std::string> id = std::move(session_id);
  if (id->empty()) id = NewSessionId();
  if (!id.ok()) return id.status();
  const auto route = ChooseRoute(request, *id, *registry_->catalog());
  if (!route.ok()) return route.status();
  const ServedPolicy& served = *route->served;
  auto options = OptionsFromProto(request, served);
  if (!options.ok()) return options.status();
  options->tenant = caller.tenant()->name();
  if (options->learning.has_value() && !caller.may_learn()) {
    return absl::PermissionDeniedError(
        "learning: expected unset, because the token has \"learning\": false, received a config");
  }
  const double target_return = options->target_return;
  SessionExtras extras;
  extras.id = *std::move(id);
  extras.quota = caller.tenant();
  if (route->shadow != nullptr) {
    extras.shadow = std::make_shared<ShadowSession>(*route->shadow, *options, clock_);
  }
  if (request.record()) {
    auto recorder = NewRecorder(route->served, response->mutable_recording());
    if (!recorder.ok()) return recorder.status();
    extras.recorder = *std::move(recorder);
  }
  id = store_->Open(route->served, *std::move(options), std::move(extras));
  if (!id.ok()) return id.status();

  const Policy& policy = served.policy();
  response->set_session_id(*std::move(id));
  response->set_policy(served.name);
  response->set_version(served.version);
  response->set_observation_size(policy.observation_size());
  *response->mutable_action_space() = ToProto(policy.action_space);
  response->set_context_length(policy.config.context);
  response->set_target_return(target_return);
  return absl::OkStatus();
}

absl::StatusOr<std::unique_ptr<EpisodeRecorder>> PolicyHandler::NewRecorder(
    const std::shared_ptr<const ServedPolicy>& served, std::string* name) const {
  if (recordings_ == nullptr) {
    return absl::FailedPreconditionError(
        "record: expected false, because the server runs without --record_dir, received true");
  }
  *name = Recordings::NewName(*served);
  return recordings_->Record(served, *name);
}

absl::Status PolicyHandler::Act(const Credential& caller, const v1::ActRequest& request,
                                v1::ActResponse* response, DeferredWork* deferred) const {
  return ActAt(caller, request.step(), request, response, deferred);
}

absl::Status PolicyHandler::ActNext(const Credential& caller, const v1::ActRequest& request,
                                    v1::ActResponse* response, DeferredWork* deferred) const {
  return ActAt(caller, std::nullopt, request, response, deferred);
}

absl::StatusOr<std::shared_ptr<SessionEntry>> PolicyHandler::FindForDecision(
    const Credential& caller, const v1::ActRequest& request) const {
  if (auto status = caller.tenant()->AcquireDecision(clock_->Now()); !status.ok()) return status;
  return store_->Find(request.session_id(), caller.tenant()->name());
}

absl::Status PolicyHandler::ActAt(const Credential& caller, std::optional<int64_t> step,
                                  const v1::ActRequest& request, v1::ActResponse* response,
                                  DeferredWork* deferred) const {
  auto entry = FindForDecision(caller, request);
  if (!entry.ok()) return entry.status();
  ActItem item = {
      .request = &request, .step = step, .entry = *std::move(entry), .response = response};
  ActTogether(absl::MakeSpan(&item, 1));
  if (item.status.ok()) deferred->Add(std::move(item.entry), shadows_);
  return item.status;
}

// A group ends before a request whose session is in the group already, so that the decisions of one
// session are made in order.
void PolicyHandler::ActMany(absl::Span<AgentAct> acts, DeferredWork* deferred,
                            absl::FunctionRef<void(absl::Span<AgentAct> group)> answered) const {
  absl::InlinedVector<ActItem, 1> items;     // of the group, without requests that were refused
  absl::InlinedVector<size_t, 1> positions;  // of `items` in `acts`
  size_t begin = 0;                          // of the group
  const auto answer_group = [&](size_t end) {
    ActTogether(absl::MakeSpan(items));
    for (size_t i = 0; i < items.size(); ++i) {
      acts[positions[i]].status = items[i].status;
      if (items[i].status.ok()) deferred->Add(std::move(items[i].entry), shadows_);
    }
    answered(acts.subspan(begin, end - begin));
    begin = end;
    items.clear();
    positions.clear();
  };
  for (size_t i = 0; i < acts.size(); ++i) {
    AgentAct& act = acts[i];
    auto entry = FindForDecision(*act.caller, *act.request);
    act.status = entry.status();
    if (!entry.ok()) continue;
    const bool again =
        absl::c_any_of(items, [&](const ActItem& item) { return item.entry == *entry; });
    if (again || items.size() == kMaxSessionsPerGroup) answer_group(i);
    items.push_back({.request = act.request,
                     .step = act.request->step(),
                     .entry = *std::move(entry),
                     .response = act.response});
    positions.push_back(i);
  }
  answer_group(acts.size());
}

absl::Status PolicyHandler::CheckBatch(const v1::ActBatchRequest& request) {
  if (request.requests_size() <= kMaxBatch) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat("requests: expected at most ", kMaxBatch,
                                                 ", received ", request.requests_size()));
}

int PolicyHandler::ActBatchGroup(const Credential& caller, const v1::ActBatchRequest& request,
                                 int first, v1::ActBatchResponse* response,
                                 DeferredWork* deferred) const {
  const int end = std::min(request.requests_size(), first + static_cast<int>(kMaxSessionsPerGroup));
  absl::InlinedVector<AgentAct, kMaxSessionsPerGroup> acts;
  for (int i = first; i < end; ++i) {
    acts.push_back({.caller = &caller,
                    .request = &request.requests(i),
                    .response = response->add_results()->mutable_response()});
  }
  ActMany(absl::MakeSpan(acts), deferred, [](absl::Span<AgentAct> /*group*/) {});
  for (int i = first; i < end; ++i) {
    const absl::Status& status = acts[static_cast<size_t>(i - first)].status;
    if (!status.ok()) SetError(status, response->mutable_results(i));
  }
  return end;
}

absl::Status PolicyHandler::EndEpisode(const Credential& caller,
                                       const v1::EndEpisodeRequest& request,
                                       v1::EndEpisodeResponse* response) const {
  const auto entry = store_->Find(request.session_id(), caller.tenant()->name());
  if (!entry.ok()) return entry.status();
  EpisodeEnd end = {.reward = request.reward(),
                    .terminated = request.terminated(),
                    .target_return = std::nullopt,
                    .truncated = request.truncated(),
                    .observation = {request.observation().begin(), request.observation().end()},
                    .executed_action = std::nullopt};
  if (request.has_target_return()) end.target_return = request.target_return();
  if (request.has_executed_action()) {
    auto executed = ParseExecutedAction(FromProto(request.executed_action()),
                                        (*entry)->served->policy().action_space);
    if (!executed.ok()) return executed.status();
    end.executed_action = *std::move(executed);
  }
  absl::MutexLock lock(&(*entry)->mutex);
  const auto summary = (*entry)->agent.EndEpisode(end);
  if (!summary.ok()) return summary.status();
  *response = ToProto(*summary);
  response->set_recording(ToProto((*entry)->agent.recording_state()));
  return absl::OkStatus();
}

absl::StatusOr<std::shared_ptr<SessionEntry>> PolicyHandler::FindReadable(
    const Credential& caller, const std::string& id) const {
  auto entry = store_->Peek(id);
  if (entry != nullptr && caller.CanRead(entry->tenant)) return entry;
  return NoSuchSession(id);
}

absl::Status PolicyHandler::GetSession(const Credential& caller,
                                       const v1::GetSessionRequest& request,
                                       v1::GetSessionResponse* response) const {
  const auto entry = FindReadable(caller, request.session_id());
  if (!entry.ok()) return entry.status();
  absl::MutexLock lock(&(*entry)->mutex);
  *response = ToProto((*entry)->agent, request.include_head_delta());
  return absl::OkStatus();
}

absl::Status PolicyHandler::Explain(const Credential& caller, const v1::ExplainRequest& request,
                                    v1::ExplainResponse* response) const {
  const auto entry = FindReadable(caller, request.session_id());
  if (!entry.ok()) return entry.status();
  return ExplainSession(**entry, response);
}

absl::Status PolicyHandler::CloseSession(const Credential& caller,
                                         const v1::CloseSessionRequest& request,
                                         v1::CloseSessionResponse* /*response*/) const {
  return store_->Close(request.session_id(), caller.tenant()->name());
}

}  // namespace spikeserve
