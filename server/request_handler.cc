#include "server/request_handler.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "server/convert.h"
#include "server/status_map.h"

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
  SessionOptions options;
  options.policy = served.name;
  options.version = served.version;
  options.seed = request.seed();
  options.target_return = request.has_target_return()
                              ? request.target_return()
                              : static_cast<double>(served.policy().target_return);
  if (auto status = CheckTargetReturn(options.target_return); !status.ok()) return status;
  const auto selection = SelectionFromProto(request);
  if (!selection.ok()) return selection.status();
  options.action_selection = *selection;
  if (request.has_learning()) {
    const auto learning =
        LearningFromProto(request.learning(), served.policy().action_space, *selection);
    if (!learning.ok()) return learning.status();
    options.learning = *learning;
  }
  auto head_delta = HeadDeltaFromProto(request, served.policy());
  if (!head_delta.ok()) return head_delta.status();
  options.head_delta = *std::move(head_delta);
  if (auto status = CheckLabels(request.labels()); !status.ok()) return status;
  options.labels.insert(request.labels().begin(), request.labels().end());
  return options;
}

// The version a new session gets. Without a routing key the session's id divides the traffic.
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

// What the shadow of a session is to see of the decision that was just made.
ShadowStep MakeShadowStep(const v1::ActRequest& request, const Session& session) {
  return {.episode = session.episode,
          .step = request.step(),
          .observation = {request.observation().begin(), request.observation().end()},
          .reward = request.reward(),
          .target_return = session.target_return,
          .served = *session.last_answer};
}

}  // namespace

void DeferredWork::Run() {
  for (const auto& entry : entries_) {
    absl::MutexLock lock(&entry->mutex);
    entry->agent.AppendPendingAction();
    if (entry->shadow == nullptr || entry->shadow_steps.empty()) continue;
    shadows_->Submit(entry->shadow, entry->served->version, std::exchange(entry->shadow_steps, {}));
  }
  entries_.clear();
}

RequestHandler::RequestHandler(const PolicyRegistry* registry, SessionStore* store,
                               ShadowRunner* shadows, const Clock* clock)
    : registry_(registry), store_(store), shadows_(shadows), clock_(clock) {}

absl::Status RequestHandler::ListPolicies(const v1::ListPoliciesRequest& /*request*/,
                                          v1::ListPoliciesResponse* response) const {
  const auto catalog = registry_->catalog();
  for (const auto& [name, policy] : catalog->policies()) {
    for (const auto& [version, served] : policy.versions) {
      *response->add_policies() = ToProto(policy, *served);
    }
  }
  return absl::OkStatus();
}

absl::Status RequestHandler::OpenSession(const v1::OpenSessionRequest& request,
                                         v1::OpenSessionResponse* response) const {
  auto id = NewSessionId();
  if (!id.ok()) return id.status();
  const auto route = ChooseRoute(request, *id, *registry_->catalog());
  if (!route.ok()) return route.status();
  const ServedPolicy& served = *route->served;
  auto options = OptionsFromProto(request, served);
  if (!options.ok()) return options.status();
  const double target_return = options->target_return;
  SessionExtras extras = {.id = *std::move(id), .shadow = nullptr};
  if (route->shadow != nullptr) {
    extras.shadow = std::make_shared<ShadowSession>(*route->shadow, *options, clock_);
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

absl::Status RequestHandler::Act(const v1::ActRequest& request, v1::ActResponse* response,
                                 DeferredWork* deferred) const {
  auto entry = store_->Find(request.session_id());
  if (!entry.ok()) return entry.status();
  {
    absl::MutexLock lock(&(*entry)->mutex);
    const Session& session = (*entry)->agent.session();
    const uint64_t decisions = session.decisions;
    const auto answer =
        (*entry)->agent.Act(request.step(), request.observation(), request.reward());
    if (!answer.ok()) return answer.status();
    const bool is_retry = session.decisions == decisions;
    if ((*entry)->shadow != nullptr && !is_retry) {
      (*entry)->shadow_steps.push_back(MakeShadowStep(request, session));
    }
    ToProto(request.session_id(), **answer, (*entry)->served->policy(), response);
  }
  deferred->Add(*std::move(entry), shadows_);
  return absl::OkStatus();
}

absl::Status RequestHandler::ActBatch(const v1::ActBatchRequest& request,
                                      v1::ActBatchResponse* response,
                                      DeferredWork* deferred) const {
  for (const v1::ActRequest& item : request.requests()) {
    v1::ActResult* result = response->add_results();
    const absl::Status status = Act(item, result->mutable_response(), deferred);
    if (status.ok()) continue;
    result->clear_response();
    result->set_code(ToGrpcCode(status.code()));
    result->set_message(std::string(status.message()));
  }
  return absl::OkStatus();
}

absl::Status RequestHandler::EndEpisode(const v1::EndEpisodeRequest& request,
                                        v1::EndEpisodeResponse* response) const {
  const auto entry = store_->Find(request.session_id());
  if (!entry.ok()) return entry.status();
  EpisodeEnd end = {.reward = request.reward(),
                    .terminated = request.terminated(),
                    .target_return = std::nullopt};
  if (request.has_target_return()) end.target_return = request.target_return();
  absl::MutexLock lock(&(*entry)->mutex);
  const auto summary = (*entry)->agent.EndEpisode(end);
  if (!summary.ok()) return summary.status();
  *response = ToProto(*summary);
  return absl::OkStatus();
}

absl::Status RequestHandler::GetSession(const v1::GetSessionRequest& request,
                                        v1::GetSessionResponse* response) const {
  const auto entry = store_->Find(request.session_id());
  if (!entry.ok()) return entry.status();
  absl::MutexLock lock(&(*entry)->mutex);
  *response = ToProto((*entry)->agent, request.include_head_delta());
  return absl::OkStatus();
}

absl::Status RequestHandler::CloseSession(const v1::CloseSessionRequest& request,
                                          v1::CloseSessionResponse* /*response*/) const {
  return store_->Close(request.session_id());
}

}  // namespace spikeserve
