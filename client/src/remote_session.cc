#include "spikeserve/remote_session.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "spikeserve/status.h"

namespace spikeserve {

absl::StatusOr<RemoteSession> RemoteSession::Open(Client* client, v1::OpenSessionRequest request,
                                                  bool reopens) {
  RemoteSession session(client, "", 0);
  session.reopening_ = std::move(request);
  if (absl::Status status = session.OpenAgain(); !status.ok()) return status;
  session.reopened_ = 0;
  if (!reopens) session.reopening_.reset();
  return session;
}

absl::Status RemoteSession::OpenAgain() {
  if (!reopening_.has_value()) {
    return absl::FailedPreconditionError(
        "session: expected one that reopens, received one that does not");
  }
  auto opened = client_->OpenSession(*reopening_);
  if (!opened.ok()) return opened.status();
  opening_ = *std::move(opened);
  session_id_ = opening_.session_id();
  step_ = 0;
  ++reopened_;
  return absl::OkStatus();
}

absl::StatusOr<v1::ActResponse> RemoteSession::Act(
    absl::Span<const float> observation, double reward,
    const std::optional<v1::Action>& executed_action) {
  absl::StatusOr<v1::ActResponse> response =
      client_->Act(MakeRequest(observation, reward, executed_action));
  if (reopening_.has_value() && IsSessionLost(response.status())) {
    if (absl::Status status = OpenAgain(); !status.ok()) return status;
    response = client_->Act(MakeRequest(observation, 0.0));
  }
  if (!response.ok()) return response;
  if (absl::Status status = Accept(*response); !status.ok()) return status;
  return response;
}

v1::ActRequest RemoteSession::MakeRequest(absl::Span<const float> observation, double reward,
                                          const std::optional<v1::Action>& executed_action) const {
  v1::ActRequest request;
  request.set_session_id(session_id_);
  request.set_step(step_);
  request.mutable_observation()->Add(observation.begin(), observation.end());
  request.set_reward(reward);
  if (executed_action.has_value()) *request.mutable_executed_action() = *executed_action;
  return request;
}

absl::Status RemoteSession::Accept(const v1::ActResponse& response) {
  if (response.session_id() != session_id_ || response.step() != step_) {
    return absl::InternalError(absl::StrCat(
        "expected the answer to step ", step_, " of session ", session_id_,
        ", received that to step ", response.step(), " of session ", response.session_id()));
  }
  ++step_;
  return absl::OkStatus();
}

absl::StatusOr<v1::EndEpisodeResponse> RemoteSession::EndEpisode(const EpisodeOutcome& outcome) {
  v1::EndEpisodeRequest request;
  request.set_session_id(session_id_);
  request.set_reward(outcome.reward);
  request.set_terminated(outcome.terminated);
  request.set_truncated(outcome.truncated);
  if (outcome.target_return.has_value()) request.set_target_return(*outcome.target_return);
  request.mutable_observation()->Add(outcome.observation.begin(), outcome.observation.end());
  if (outcome.executed_action.has_value()) {
    *request.mutable_executed_action() = *outcome.executed_action;
  }
  absl::StatusOr<v1::EndEpisodeResponse> response = client_->EndEpisode(request);
  if (response.ok()) step_ = 0;
  if (reopening_.has_value() && IsSessionLost(response.status())) {
    if (absl::Status status = OpenAgain(); !status.ok()) return status;
  }
  return response;
}

}  // namespace spikeserve
