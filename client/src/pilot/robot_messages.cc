#include "client/src/pilot/robot_messages.h"

#include <string>

#include "absl/strings/str_cat.h"
#include "client/src/item_status.h"
#include "client/src/steady_time.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"

namespace spikeserve::piloting {
namespace {

robot::Failure FailureOf(const absl::Status& status) {
  if (absl::IsNotFound(status)) return robot::Failure::kNotFound;
  if (absl::IsInvalidArgument(status)) return robot::Failure::kInvalid;
  if (IsRetryable(status)) return robot::Failure::kAway;
  return absl::IsFailedPrecondition(status) || absl::IsDataLoss(status) ? robot::Failure::kConflict
                                                                        : robot::Failure::kOther;
}

void ToProto(const robot::ActionView& action, const robot::ActionShape& shape,
             v1::Action* message) {
  if (shape.is_box()) {
    message->mutable_continuous()->mutable_values()->Assign(action.continuous.begin(),
                                                            action.continuous.end());
  } else {
    message->set_discrete(action.discrete);
  }
}

void ToProto(const robot::ChooserView& chooser, v1::ActionSource* message) {
  message->set_kind(static_cast<v1::ActionSource::Kind>(chooser.kind));
  message->set_operator_id(std::string(chooser.operator_id));
}

void ToProto(const robot::Report& report, v1::BeatReport* message) {
  const auto of = [&](robot::Source source) {
    return report.counts->by_source[static_cast<size_t>(source)];
  };
  message->set_fresh(of(robot::Source::kFresh));
  message->set_held(of(robot::Source::kHeld));
  message->set_local(of(robot::Source::kLocal));
  message->set_safe(of(robot::Source::kSafe));
  message->set_late_answers(report.counts->late_answers);
  message->set_cancelled_calls(report.counts->cancelled_requests);
  message->set_reconnects(report.counts->reconnects);
  message->set_invalid_observations(report.counts->invalid_observations);
  message->set_longest_gap_seconds(absl::ToDoubleSeconds(FromRobot(report.longest_gap)));
  message->set_oldest_age_seconds(absl::ToDoubleSeconds(FromRobot(report.oldest_age)));
}

}  // namespace

robot::Now ReadClocks() { return {ToRobot(SteadyNow()), ToRobot(RobotNow())}; }

absl::Status LostEpisode(absl::string_view reason) {
  return absl::UnavailableError(absl::StrCat("the server has not learned the end: ", reason));
}

robot::ActionView ViewOf(const v1::Action& action) {
  const auto& values = action.continuous().values();
  const int64_t index = action.has_continuous() ? -1 : action.discrete();  // -1 is no index
  return {index, {values.data(), static_cast<size_t>(values.size())}};
}

robot::ChooserView ViewOf(const v1::ActionSource& source) {
  return {static_cast<robot::Chooser>(source.kind()), source.operator_id()};
}

robot::ActionShape ShapeOf(const v1::ActionSpace& space) {
  const auto& low = space.box().low();
  const auto& high = space.box().high();
  return {space.discrete().n(), {low.begin(), low.end()}, {high.begin(), high.end()}};
}

robot::Opening OpeningOf(const v1::OpenSessionResponse& opened) {
  const bool is_stored = opened.durability() == v1::ASYNC || opened.durability() == v1::SYNC;
  return {.history_limit = opened.history_limit(), .is_stored = is_stored};
}

robot::Error ErrorOf(const absl::Status& status) {
  robot::Error error = {.kind = FailureOf(status),
                        .message = std::string(status.message()),
                        .text = status.ToString(),
                        .expected_decision = ExpectedDecision(status),
                        .expected_episode = ExpectedEpisode(status)};
  if (const auto after = RetryAfter(status)) error.retry_after = ToRobot(*after);
  return error;
}

robot::Reply ReplyOf(const v1::ActResponse& reply, robot::Error* error) {
  robot::Reply view = {.next_step = reply.next_step(),
                       .observed_at = robot::Time(reply.observed_at()),
                       .stays_safe = reply.wiring().is_safe_action() || reply.has_hold(),
                       .durable_decision = reply.durable_decision(),
                       .durable_episode = reply.durable_episode(),
                       .has_ended = reply.has_ended()};
  if (reply.has_action()) view.action = ViewOf(reply.action());
  view.chooser = ViewOf(reply.source());
  if (reply.has_ended()) view.episode_return = ReturnOf(reply.ended());
  if (reply.has_error()) {
    *error = ErrorOf(StatusOfItem(reply.error()));
    view.error = error;
  }
  return view;
}

std::optional<double> ReturnOf(const v1::EndEpisodeResponse& ended) {
  if (ended.energy_joules() == 0.0) return std::nullopt;
  return ended.episode_return();
}

void ToProto(const robot::StepLog& log, const robot::Request& request, v1::ActRequest* message) {
  message->set_step(request.step());
  message->set_decision(request.decision);
  for (uint64_t number = request.begin; number < request.end; ++number) {
    const robot::StepView step = log.StepOf(*request.episode, number);
    v1::Beat* const beat = message->add_history();
    beat->set_step(static_cast<int64_t>(number - request.episode->first));
    beat->mutable_observation()->Assign(step.observation.begin(), step.observation.end());
    beat->set_reward(step.reward);
    ToProto(step.executed, log.shape(), beat->mutable_executed());
    ToProto(step.chooser, beat->mutable_source());
  }
  for (uint64_t number = request.skipped; number < request.begin; ++number) {
    message->add_skipped_rewards(log.RewardOf(number));
  }
  if (request.report.has_value()) ToProto(*request.report, message->mutable_report());
  if (request.ends) EndToProto(log, message->mutable_end_episode());
  if (!request.asks) return;
  const robot::StepView step = log.At(request.end);
  message->mutable_observation()->Assign(step.observation.begin(), step.observation.end());
  message->set_reward(step.reward);
  message->set_observed_at(request.observed_at.count());
  message->set_traceparent(std::string(request.traceparent));
}

void EndToProto(const robot::StepLog& log, v1::EndEpisodeRequest* message) {
  const robot::Episode& episode = log.oldest();
  const robot::Outcome& outcome = episode.outcome;
  message->set_reward(outcome.reward);
  message->set_terminated(outcome.terminated);
  message->set_truncated(outcome.truncated);
  if (outcome.target_return.has_value()) message->set_target_return(*outcome.target_return);
  message->mutable_observation()->Assign(outcome.observation.begin(), outcome.observation.end());
  const robot::KeptStep& last = episode.last.back();
  ToProto(last.executed.view(), log.shape(), message->mutable_executed_action());
  ToProto(last.chooser.view(), message->mutable_executed_source());
  message->set_episode(episode.index);
  message->set_steps(static_cast<int64_t>(episode.steps));
}

}  // namespace spikeserve::piloting
