#include "server/agent/step_conversion.h"

#include <algorithm>
#include <optional>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "server/messages/convert.h"

namespace spikeserve {
namespace {

ReportedAction Executed(const v1::Action& action, const v1::ActionSource& source) {
  ReportedAction executed = FromProto(action);
  executed.source = {.kind = source.kind(), .operator_id = source.operator_id()};
  return executed;
}

PastStep ReadBeat(const void* request, size_t i) {
  const v1::Beat& beat = static_cast<const v1::ActRequest*>(request)->history(static_cast<int>(i));
  return {.step = beat.step(),
          .observation = beat.observation(),
          .reward = beat.reward(),
          .executed = Executed(beat.executed(), beat.source()),
          .has_reward = beat.has_reward()};
}

// Returns the action that was executed before the decision of the request, if it says so.
std::optional<ReportedAction> ExecutedBefore(const v1::ActRequest& request) {
  if (request.history_size() > 0) {
    const v1::Beat& last = request.history(request.history_size() - 1);
    if (last.observation().empty()) return std::nullopt;  // the session has skipped it
    return Executed(last.executed(), last.source());
  }
  if (!request.has_executed_action() && !request.has_executed_source()) return std::nullopt;
  return Executed(request.executed_action(), request.executed_source());
}

BeatCounts CountsOf(const v1::BeatReport& report) {
  return {.fresh = report.fresh(),
          .held = report.held(),
          .local = report.local(),
          .safe = report.safe(),
          .late_answers = report.late_answers(),
          .cancelled_calls = report.cancelled_calls(),
          .reconnects = report.reconnects(),
          .invalid_observations = report.invalid_observations(),
          .longest_gap_seconds = report.longest_gap_seconds(),
          .oldest_age_seconds = report.oldest_age_seconds()};
}

StepTimes TimesOf(const v1::ActRequest& request, absl::Duration received, SessionEntry& entry)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex) {
  StepTimes times = {.link = &entry.robot,
                     .received = received,
                     .is_new_session = entry.journal == nullptr || entry.journal->is_new()};
  if (request.has_observed_at()) times.observed_at = absl::Nanoseconds(request.observed_at());
  if (request.has_valid_until()) times.valid_until = absl::Nanoseconds(request.valid_until());
  if (request.has_report()) times.report = CountsOf(request.report());
  return times;
}

void SetEnd(const v1::EndEpisodeRequest& request, Step* step) {
  if (request.has_episode()) step->place.episode = request.episode();
  step->has_reward = request.has_reward();
  step->executed = std::nullopt;
  if (request.has_executed_action() || request.has_executed_source()) {
    step->executed = Executed(request.executed_action(), request.executed_source());
  }
  step->end =
      EpisodeEnd{.reward = request.reward(),
                 .terminated = request.terminated(),
                 .truncated = request.truncated(),
                 .observation = {request.observation().begin(), request.observation().end()}};
  if (request.has_target_return()) step->end->target_return = request.target_return();
}

absl::Status CheckEnd(const v1::ActRequest& request) {
  const v1::EndEpisodeRequest& end = request.end_episode();
  if (!request.observation().empty()) {
    return InvalidArgument("observation", "none, because the request has end_episode",
                           absl::StrCat(request.observation_size(), " values"));
  }
  if (!end.session_id().empty() && end.session_id() != request.session_id()) {
    return InvalidArgument("end_episode.session_id", "none, or that of the request",
                           Quoted(end.session_id()));
  }
  if (!request.has_decision() || !end.has_episode()) {
    return InvalidArgument("end_episode", "a request with decision and end_episode.episode",
                           "one without");
  }
  if (!end.has_steps() || end.steps() != request.step()) {
    return InvalidArgument("end_episode.steps", absl::StrCat(request.step(), " as step"),
                           end.steps());
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status ToStep(const v1::ActRequest& request, absl::Duration received, bool is_next,
                    SessionEntry& entry, Step* step) {
  step->session = &entry.agent;
  step->place = {};
  if (!is_next) step->place.step = request.step();
  if (!is_next && request.has_decision()) step->place.decision = request.decision();
  step->skipped_rewards = request.skipped_rewards();
  step->history = {static_cast<size_t>(request.history_size()), &request, ReadBeat};
  step->observation = request.observation();
  step->reward = request.reward();
  step->has_reward = request.has_reward();
  step->executed = ExecutedBefore(request);
  step->times = std::nullopt;
  if (HasBeats(request)) step->times = TimesOf(request, received, entry);
  step->end = std::nullopt;
  if (!request.has_end_episode()) return absl::OkStatus();
  SetEnd(request.end_episode(), step);
  return CheckEnd(request);
}

void ToStep(const v1::EndEpisodeRequest& request, SessionEntry& entry, Step* step) {
  step->session = &entry.agent;
  if (request.has_steps()) step->place.step = request.steps();
  SetEnd(request, step);
}

void ToProto(const Step& step, const SessionEntry& entry, v1::EndEpisodeResponse* response) {
  if (!step.result.summary.has_value()) return response->set_steps(*step.place.step);
  *response = ToProto(*step.result.summary);
  const auto& recorder = entry.recorder;
  response->set_recording(
      ToProto(recorder == nullptr ? RecordingState::kNotRecorded : recorder->last_state()));
}

void ToProto(const v1::ActRequest& request, const Step& step, absl::Duration received,
             const SessionEntry& entry, v1::ActResponse* response) {
  const StepOutcome& result = step.result;
  if (result.answer != nullptr) {
    ToProto(request.session_id(), *result.answer, entry.served->policy(), response);
    WiringToProto(entry.agent, response);
  } else if (entry.agent.hold() != nullptr) {
    ToProto(*entry.agent.hold(), response->mutable_hold());
  }
  if (step.end.has_value()) ToProto(step, entry, response->mutable_ended());
  if (!HasBeats(request) && !step.end.has_value()) return;
  response->set_session_id(request.session_id());
  response->set_step(request.step());
  if (request.has_observed_at()) response->set_observed_at(request.observed_at());
  response->set_next_step(entry.agent.session().step);
  response->set_appended(result.appended);
  response->set_dropped(result.dropped);
  response->set_expired(result.expired);
  const absl::Duration queued = result.begun - received - result.spent;
  response->set_queue_seconds(absl::ToDoubleSeconds(std::max(queued, absl::ZeroDuration())));
  response->set_append_seconds(absl::ToDoubleSeconds(result.spent));
}

void ToProto(const BeatCounts& counts, v1::BeatReport* report) {
  report->set_fresh(counts.fresh);
  report->set_held(counts.held);
  report->set_local(counts.local);
  report->set_safe(counts.safe);
  report->set_late_answers(counts.late_answers);
  report->set_cancelled_calls(counts.cancelled_calls);
  report->set_reconnects(counts.reconnects);
  report->set_invalid_observations(counts.invalid_observations);
  report->set_longest_gap_seconds(counts.longest_gap_seconds);
  report->set_oldest_age_seconds(counts.oldest_age_seconds);
}

}  // namespace spikeserve
