#include "spikeserve/remote_session.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "client/src/replicas.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

// Returns the error of a server that has `decisions` of the session, which are too few.
absl::Status OutdatedError(uint64_t expected, uint64_t decisions) {
  return StatusFromCode(static_cast<int32_t>(absl::StatusCode::kFailedPrecondition),
                        absl::StrCat("decisions: expected ", expected, ", received ", decisions),
                        /*retry_after_seconds=*/std::nullopt, /*expected_decision=*/decisions);
}

template <typename Request>
void SetExecuted(const std::optional<ExecutedAction>& executed, Request* request) {
  if (!executed.has_value()) return;
  *request->mutable_executed_action() = executed->action;
  if (executed->source.kind() != v1::ActionSource::UNKNOWN) {
    *request->mutable_executed_source() = executed->source;
  }
}

}  // namespace

absl::StatusOr<RemoteSession> RemoteSession::Open(Client* client, v1::OpenSessionRequest request,
                                                  bool reopens, std::shared_ptr<Route> route) {
  RemoteSession session(client, "", 0);
  request.set_names_in_any_order(true);
  session.reopening_ = std::move(request);
  session.route_ = std::move(route);
  if (absl::Status status = session.OpenAgain(); !status.ok()) return status;
  session.reopened_ = 0;
  session.reopening_->clear_session_id();  // the next session has another one
  if (!reopens) {
    session.reopening_.reset();
    // A session that no store has stays at its server.
    client->replicas_->Pin(*session.route_, !session.is_stored_);
  }
  return session;
}

absl::Status RemoteSession::OpenAgain() {
  if (!reopening_.has_value()) {
    return absl::FailedPreconditionError(
        "session: expected one that reopens, received one that does not");
  }
  v1::OpenSessionRequest request = *reopening_;
  if (request.session_id().empty()) request.set_session_id(DrawId());
  auto route = route_ != nullptr && route_->key != session_id_
                   ? route_
                   : std::make_shared<Route>(request.session_id());
  auto opened = client_->OpenSession(request, route);
  if (!opened.ok()) return opened.status();
  opening_ = *std::move(opened);
  order_ = FeatureOrder(request, opening_);
  session_id_ = opening_.session_id();
  route_ = std::move(route);
  step_ = 0;
  decision_ = 0;
  episode_ = 0;
  unacknowledged_ = {};
  is_stored_ = opening_.durability() == v1::ASYNC || opening_.durability() == v1::SYNC;
  ++reopened_;
  return absl::OkStatus();
}

template <typename Response>
absl::StatusOr<Response> RemoteSession::CallUpToDate(
    absl::FunctionRef<absl::StatusOr<Response>()> call, bool reads) {
  RetrySchedule schedule(client_->options().retry, session_id_);
  for (bool is_first = true;; is_first = false) {
    absl::StatusOr<Response> response = call();
    if (response.ok() || !ExpectedDecision(response.status()).has_value()) return response;
    // A server that has just claimed a session misses decisions once, so the first time has no
    // delay.
    if (!is_first) {
      const auto delay = schedule.NextDelay(std::nullopt);
      if (!delay.has_value()) return response;
      client_->options().retry.sleep(*delay);
    }
    if (absl::Status status = CatchUp(response.status(), reads); !status.ok()) return status;
  }
}

absl::Status RemoteSession::CatchUp(const absl::Status& error) {
  return CatchUp(error, /*reads=*/false);
}

absl::Status RemoteSession::CatchUp(const absl::Status& error, bool reads) {
  const auto expected = ExpectedDecision(error);
  if (!expected.has_value() || !is_stored_) return error;
  if (unacknowledged_.Covers(*expected)) {
    return unacknowledged_.SendAgain(*expected, client_, route_);
  }
  if (reads && unacknowledged_.size() > 0) return unacknowledged_.SendLastAgain(client_, route_);
  return error;
}

absl::StatusOr<v1::ActResponse> RemoteSession::Act(
    absl::Span<const float> observation, double reward,
    const std::optional<ExecutedAction>& executed_action) {
  return Decide(MakeRequest(observation, reward, executed_action));
}

absl::StatusOr<v1::ActResponse> RemoteSession::Decide(const v1::ActRequest& request) {
  auto response = CallUpToDate<v1::ActResponse>([&] { return client_->Act(request, route_); });
  if (reopening_.has_value() && IsSessionLost(response.status())) {
    if (absl::Status status = OpenAgain(); !status.ok()) return status;
    const v1::ActRequest first = MakeOrdered(request.observation(), 0.0, std::nullopt);
    response = CallUpToDate<v1::ActResponse>([&] { return client_->Act(first, route_); });
  }
  if (!response.ok()) return response;
  if (absl::Status status = Accept(*response); !status.ok()) return status;
  ToRobot(&*response);
  return response;
}

v1::ActRequest RemoteSession::MakeRequest(absl::Span<const float> observation, double reward,
                                          const std::optional<ExecutedAction>& executed_action) {
  std::optional<ExecutedAction> executed = executed_action;
  if (executed.has_value()) order_.ToPolicy(&executed->action);
  return MakeOrdered(order_.Observation(observation), reward, executed);
}

v1::ActRequest RemoteSession::MakeOrdered(absl::Span<const float> observation, double reward,
                                          const std::optional<ExecutedAction>& executed_action) {
  v1::ActRequest request;
  request.set_session_id(session_id_);
  request.set_step(step_);
  request.mutable_observation()->Add(observation.begin(), observation.end());
  request.set_reward(reward);
  SetExecuted(executed_action, &request);
  if (decision_.has_value()) request.set_decision(*decision_);
  if (is_stored_) request_ = request;
  return request;
}

absl::Status RemoteSession::Accept(const v1::ActResponse& response) {
  if (response.session_id() != session_id_ || response.step() != step_) {
    return absl::InternalError(absl::StrCat(
        "expected the answer to step ", step_, " of session ", session_id_,
        ", received that to step ", response.step(), " of session ", response.session_id()));
  }
  if (is_stored_) {
    unacknowledged_.Add(*decision_, request_, response);
    request_.Clear();
  }
  ++step_;
  if (decision_.has_value()) ++*decision_;
  return absl::OkStatus();
}

absl::StatusOr<v1::EndEpisodeResponse> RemoteSession::EndEpisode(const EpisodeOutcome& outcome) {
  v1::EndEpisodeRequest request;
  request.set_session_id(session_id_);
  request.set_reward(outcome.reward);
  request.set_terminated(outcome.terminated);
  request.set_truncated(outcome.truncated);
  if (outcome.target_return.has_value()) request.set_target_return(*outcome.target_return);
  const auto observation = order_.Observation(outcome.observation);
  request.mutable_observation()->Add(observation.begin(), observation.end());
  SetExecuted(outcome.executed_action, &request);
  if (request.has_executed_action()) order_.ToPolicy(request.mutable_executed_action());
  if (episode_.has_value()) {
    request.set_episode(*episode_);
    request.set_steps(step_);
  }
  auto response =
      CallUpToDate<v1::EndEpisodeResponse>([&] { return client_->EndEpisode(request, route_); });
  if (response.ok()) {
    if (is_stored_) {
      unacknowledged_.Add(*decision_, request, *response);
    }
    step_ = 0;
    if (episode_.has_value()) ++*episode_;
  }
  if (reopening_.has_value() && IsSessionLost(response.status())) {
    if (absl::Status status = OpenAgain(); !status.ok()) return status;
  }
  return response;
}

absl::StatusOr<v1::GetSessionResponse> RemoteSession::State(bool include_head_delta) {
  return CallUpToDate<v1::GetSessionResponse>(
      [&]() -> absl::StatusOr<v1::GetSessionResponse> {
        auto state = client_->GetSession(session_id_, include_head_delta, route_);
        // A former owner may have all decisions, but not the end of the last episode.
        const bool is_outdated = state.ok() && is_stored_ &&
                                 (state->decisions() < *decision_ || state->episode() < *episode_);
        if (is_outdated) return OutdatedError(*decision_, state->decisions());
        return state;
      },
      /*reads=*/true);
}

absl::StatusOr<v1::ExplainResponse> RemoteSession::Explain() {
  return CallUpToDate<v1::ExplainResponse>(
      [&]() -> absl::StatusOr<v1::ExplainResponse> {
        auto explained = client_->Explain(session_id_, route_);
        const bool is_outdated =
            explained.ok() && is_stored_ &&
            (explained->answer().step() != step_ - 1 || explained->episode() != *episode_);
        if (is_outdated) return OutdatedError(*decision_, 0);
        return explained;
      },
      /*reads=*/true);
}

}  // namespace spikeserve
