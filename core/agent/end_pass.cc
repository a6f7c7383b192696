#include <memory>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/agent/session_passes.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

absl::Status NoDecisionError() {
  return absl::FailedPreconditionError(
      "step: expected at least one decision since the last episode ended, received none");
}

// Returns whether the request repeats the end of the episode before, and nothing was decided since.
bool RepeatsEnd(const Place& place, const Session& session) {
  return session.step == 0 && session.last_end != nullptr &&
         (!place.episode.has_value() || *place.episode == session.episode - 1);
}

// Returns whether the episode that the request names, by its decision, has ended, whatever was
// decided since.
bool HasEnded(const Place& place, const Session& session) {
  return place.decision.has_value() && *place.episode == session.episode - 1 &&
         *place.decision + static_cast<uint64_t>(session.step) == session.decisions;
}

// Checks that the request belongs to the running episode, or to the last one if it `repeats`.
absl::Status CheckPlace(const Place& place, bool repeats, const Session& session) {
  const int64_t episode = repeats ? session.episode - 1 : session.episode;
  const int64_t steps = repeats ? session.last_end->summary.steps : session.step;
  const auto refuse = [](const char* field, int64_t expected, int64_t received) {
    return absl::FailedPreconditionError(
        absl::StrCat(field, ": expected ", expected, ", received ", received));
  };
  if (place.episode.has_value() && *place.episode != episode) {
    return refuse("episode", episode, *place.episode);
  }
  if (place.step.has_value() && *place.step != steps) {
    return refuse("steps", steps, *place.step);
  }
  return place.episode.has_value() && !repeats && session.step == 0 ? NoDecisionError()
                                                                    : absl::OkStatus();
}

void StartNextEpisode(const EpisodeEnd& end, Session* session) {
  const double target_return = end.target_return.value_or(session->options.target_return);
  ++session->episode;
  session->step = 0;
  session->target_return = target_return;
  session->return_to_go = target_return;
  session->episode_return = 0.0;
  session->episode_spikes = 0;
  session->episode_energy_joules = 0.0;
  session->history.Clear();
  session->last_answer.reset();
}

}  // namespace

void AgentSession::EndPass::Take(Step& step, StepBudget* budget) {
  AgentSession& agent = *step.session;
  step.result.status = TakeUnlessRefused(step, budget);
  if (step.result.status.ok() && !step.result.finished) return;
  if (!step.result.status.ok()) agent.RestoreSkipped();
  agent.before_skipped_ = nullptr;
}

absl::Status AgentSession::EndPass::TakeUnlessRefused(Step& step, StepBudget* budget) {
  AgentSession& agent = *step.session;
  const Session& session = agent.session_;
  const Place& place = step.place;
  StepOutcome& result = step.result;
  // A request that names its decision may have a history, which is added after all checks.
  const bool is_behind = place.decision.has_value();
  if (is_behind) RETURN_IF_ERROR(Annotate(CheckValues(step), "end_episode"));
  if (!is_behind || *place.episode == session.episode) {
    RETURN_IF_ERROR(HistoryPass::Take(step, budget).status());
    if (!result.finished) return absl::OkStatus();
  }
  result.begun = agent.clock_->Now();
  const bool has_ended = HasEnded(place, session);
  result.is_retry = has_ended || RepeatsEnd(place, session);
  if (!has_ended) RETURN_IF_ERROR(CheckPlace(place, result.is_retry, session));
  if (!is_behind) RETURN_IF_ERROR(CheckValues(step));
  if (has_ended && session.last_end == nullptr) return absl::OkStatus();
  if (has_ended && !step.end->executed_action.has_value() && step.history.size > 0) {
    ASSIGN_OR_RETURN(step.end->executed_action,
                     ParseExecutedAction(step.history[step.history.size - 1].executed,
                                         agent.policy().action_space));
  }
  if (result.is_retry || session.step == 0) {
    ASSIGN_OR_RETURN(result.summary, Repeat(*step.end, agent));
    return absl::OkStatus();
  }
  // Behind a history, the reward was checked with it.
  if (!step.has_past()) {
    RETURN_IF_ERROR(CheckReward(step.end->reward, NextReturnToGo(session, step.end->reward)));
  }
  ASSIGN_OR_RETURN(result.summary, End(step));
  if (!step.has_reward) agent.CountMissingRewards(1);
  return absl::OkStatus();
}

absl::Status AgentSession::EndPass::CheckValues(Step& step) {
  const Policy& policy = step.session->policy();
  EpisodeEnd& end = *step.end;
  if (step.executed.has_value()) {
    ASSIGN_OR_RETURN(end.executed_action, ParseExecutedAction(*step.executed, policy.action_space));
  }
  if (!end.observation.empty()) {
    RETURN_IF_ERROR(CheckObservation(end.observation, policy.observation_size()));
  }
  return end.target_return.has_value() ? CheckTargetReturn(*end.target_return) : absl::OkStatus();
}

absl::StatusOr<EpisodeSummary> AgentSession::EndPass::Repeat(const EpisodeEnd& end,
                                                             AgentSession& agent) {
  const Session& session = agent.session_;
  agent.head_.TakeMerged(&agent.session_);
  if (session.last_end != nullptr && IsSameEnd(session.last_end->end, end)) {
    return session.last_end->summary;
  }
  if (session.step == 0) return NoDecisionError();
  return absl::FailedPreconditionError(
      "episode: expected the same end as before, received another one");
}

absl::StatusOr<EpisodeSummary> AgentSession::EndPass::End(const Step& step) {
  const EpisodeEnd& end = *step.end;
  AgentSession& agent = *step.session;
  Session& session = agent.session_;
  agent.head_.TakeMerged(&session);
  if (agent.contribution() != nullptr) {
    return absl::UnavailableError(
        "fleet head: has not taken the last episode of the session yet; try again");
  }
  const bool is_known = !session.history.empty();  // otherwise the last steps were skipped
  if (is_known) DecisionPass::ConfirmNeutral(step, end.executed_action);
  if (is_known && end.executed_action.has_value()) {
    agent.TakeExecuted(*end.executed_action,
                       step.executed.has_value() ? step.executed->source : ReportedSource());
  }
  if (is_known) agent.CountSource(session.executed_source);
  // As it was executed, however the agent has reported that, so that the same end is known again.
  EpisodeEnd taken = end;
  if (is_known) taken.executed_action = session.history.action(session.history.size() - 1);
  const double episode_return = session.episode_return + end.reward;
  const double target_return = session.target_return;
  EpisodeSummary summary = {.episode_return = episode_return,
                            .steps = session.step,
                            .spikes = session.episode_spikes,
                            .energy_joules = session.episode_energy_joules,
                            .learning = std::nullopt,
                            .awaits_verdict = agent.head_.AwaitVerdict(end, &session)};
  if (!summary.awaits_verdict) {
    summary.learning = agent.head_.OnEpisodeEnd(end, episode_return, *agent.clock_, &session);
  }
  StartNextEpisode(end, &session);
  agent.blind_rewards_.clear();
  session.last_end = std::make_shared<const EndedEpisode>(
      EndedEpisode{.end = std::move(taken), .summary = summary});
  agent.DropContext();
  std::optional<double> is_final;
  if (!summary.awaits_verdict) is_final = episode_return;
  agent.Report(&SessionListener::OnEpisodeEnd, is_final, target_return);
  return summary;
}

}  // namespace spikeserve
