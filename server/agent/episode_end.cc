#include "server/agent/episode_end.h"

#include <optional>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/action/reported_action.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/session/session_value.h"
#include "server/messages/convert.h"

namespace spikeserve {
namespace {

// Returns whether the request repeats the end of the episode before, and nothing was decided since.
bool RepeatsEnd(const v1::EndEpisodeRequest& request, const Session& session) {
  return session.step == 0 && session.last_end != nullptr &&
         (!request.has_episode() || request.episode() == session.episode - 1);
}

// Checks that the request belongs to the running episode, or to the last one if it `repeats`.
absl::Status CheckEpisode(const v1::EndEpisodeRequest& request, bool repeats,
                          const Session& session) {
  const int64_t episode = repeats ? session.episode - 1 : session.episode;
  const int64_t steps = repeats ? session.last_end->summary.steps : session.step;
  const auto refuse = [](const char* field, int64_t expected, int64_t received) {
    return absl::FailedPreconditionError(
        absl::StrCat(field, ": expected ", expected, ", received ", received));
  };
  if (request.has_episode() && request.episode() != episode) {
    return refuse("episode", episode, request.episode());
  }
  if (request.has_steps() && request.steps() != steps) {
    return refuse("steps", steps, request.steps());
  }
  if (request.has_episode() && !repeats && session.step == 0) {
    return absl::FailedPreconditionError(
        "step: expected at least one decision since the last episode ended, received none");
  }
  return absl::OkStatus();
}

// REQUIRES: CheckEnd returned OK.
EpisodeEnd EndOf(const v1::EndEpisodeRequest& request, const Policy& policy) {
  EpisodeEnd end = {.reward = request.reward(),
                    .terminated = request.terminated(),
                    .target_return = std::nullopt,
                    .truncated = request.truncated(),
                    .observation = {request.observation().begin(), request.observation().end()},
                    .executed_action = std::nullopt};
  if (request.has_target_return()) end.target_return = request.target_return();
  if (request.has_executed_action()) {
    end.executed_action =
        *ParseExecutedAction(FromProto(request.executed_action()), policy.action_space);
  }
  return end;
}

// As EndOf, of a request whose last beat may have the executed action.
absl::StatusOr<EpisodeEnd> EndOf(const v1::ActRequest& request, const Policy& policy) {
  EpisodeEnd end = EndOf(request.end_episode(), policy);
  if (!end.executed_action.has_value() && request.history_size() > 0) {
    const v1::Beat& last = request.history(request.history_size() - 1);
    ASSIGN_OR_RETURN(end.executed_action,
                     ParseExecutedAction(FromProto(last.executed()), policy.action_space));
  }
  return end;
}

// Begins the span of a merge into the head of a fleet that the end of the episode itself does,
// because the session is not stored; empty for other sessions.
Span StartMerge(const Span& call, const SessionEntry& entry)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex) {
  const auto& learning = entry.agent.session().options.learning;
  const bool merges = learning.has_value() && learning->scope == Scope::kFleet;
  return merges && entry.journal == nullptr ? call.Child("merge") : Span();
}

absl::Status AnswerWith(const absl::StatusOr<EpisodeSummary>& summary, const SessionEntry& entry,
                        v1::EndEpisodeResponse* response)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex) {
  if (!summary.ok()) return summary.status();
  *response = ToProto(*summary);
  const auto& recorder = entry.recorder;
  response->set_recording(
      ToProto(recorder == nullptr ? RecordingState::kNotRecorded : recorder->last_state()));
  return absl::OkStatus();
}

}  // namespace

absl::Status CheckEnd(const v1::EndEpisodeRequest& end, const Policy& policy) {
  if (end.has_executed_action()) {
    RETURN_IF_ERROR(
        ParseExecutedAction(FromProto(end.executed_action()), policy.action_space).status());
  }
  if (!end.observation().empty()) {
    RETURN_IF_ERROR(CheckObservation(end.observation(), policy.observation_size()));
  }
  return end.has_target_return() ? CheckTargetReturn(end.target_return()) : absl::OkStatus();
}

absl::Status CheckEndBehindHistory(const v1::ActRequest& request, const Policy& policy) {
  const v1::EndEpisodeRequest& end = request.end_episode();
  if (!request.observation().empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat("observation: expected none, because the request has end_episode, received ",
                     request.observation_size(), " values"));
  }
  if (!end.session_id().empty() && end.session_id() != request.session_id()) {
    return absl::InvalidArgumentError(
        absl::StrCat("end_episode.session_id: expected none, or that of the request, received ",
                     Quoted(end.session_id())));
  }
  if (!request.has_decision() || !end.has_episode()) {
    return absl::InvalidArgumentError(
        "end_episode: expected a request with decision and end_episode.episode, received one "
        "without");
  }
  if (!end.has_steps() || end.steps() != request.step()) {
    return absl::InvalidArgumentError(absl::StrCat("end_episode.steps: expected ", request.step(),
                                                   " as step, received ", end.steps()));
  }
  return Annotate(CheckEnd(end, policy), "end_episode");
}

absl::Status EndEpisodeOf(SessionEntry& entry, const v1::EndEpisodeRequest& request,
                          const Span& call, v1::EndEpisodeResponse* response) {
  AgentSession& agent = entry.agent;
  const bool repeats = RepeatsEnd(request, agent.session());
  RETURN_IF_ERROR(CheckEpisode(request, repeats, agent.session()));
  RETURN_IF_ERROR(CheckEnd(request, agent.policy()));
  const EpisodeEnd end = EndOf(request, agent.policy());
  Span merge = StartMerge(call, entry);
  const auto summary = agent.EndEpisode(end);
  if (summary.ok() && !repeats && !request.has_reward()) agent.CountMissingRewards(1);
  merge.Fail(summary.status());
  merge.End();
  return AnswerWith(summary, entry, response);
}

absl::Status EndBehindHistory(SessionEntry& entry, const v1::ActRequest& request, const Span& call,
                              v1::EndEpisodeResponse* response) {
  SPIKESERVE_DCHECK(CheckEndBehindHistory(request, entry.agent.policy()).ok());
  const v1::EndEpisodeRequest& end = request.end_episode();
  const Session& session = entry.agent.session();
  const bool has_ended =
      end.episode() + 1 == session.episode &&
      request.decision() + static_cast<uint64_t>(session.step) == session.decisions;
  if (!has_ended) return EndEpisodeOf(entry, end, call, response);
  if (session.last_end != nullptr) {
    ASSIGN_OR_RETURN(const auto again, EndOf(request, entry.agent.policy()));
    return AnswerWith(entry.agent.RepeatEnd(again), entry, response);
  }
  response->set_steps(end.steps());
  return absl::OkStatus();
}

}  // namespace spikeserve
