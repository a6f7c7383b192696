#include "server/messages/step_convert.h"

#include <algorithm>
#include <optional>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/engine/energy.h"
#include "server/base/expected_decision.h"
#include "server/base/retry_delay.h"

namespace spikeserve {

ReportedAction FromProto(const v1::Action& action) {
  if (action.has_discrete()) return action.discrete();
  if (action.has_continuous()) return absl::MakeConstSpan(action.continuous().values());
  return std::monostate();
}

void ToProto(const Action& action, bool discrete, v1::Action* proto) {
  if (discrete) return proto->set_discrete(action.discrete);
  proto->mutable_continuous()->mutable_values()->Add(action.continuous.begin(),
                                                     action.continuous.end());
}

void ToProto(const Hold& hold, v1::Hold* proto) {
  proto->set_id(hold.id);
  proto->set_reason(hold.reason);
}

v1::RecordingState ToProto(RecordingState state) {
  switch (state) {
    case RecordingState::kQueued:
      return v1::QUEUED;
    case RecordingState::kStored:
      return v1::STORED;
    case RecordingState::kNotRecorded:
      break;
  }
  return v1::NOT_RECORDED;
}

v1::LearningSummary ToProto(const LearningSummary& summary) {
  v1::LearningSummary proto;
  proto.set_updates(summary.updates);
  proto.set_rejected_updates(summary.rejected);
  proto.set_head_drift(summary.head_drift);
  proto.set_modulator_mean(summary.returns.mean);
  proto.set_modulator_std(summary.returns.deviation());
  proto.set_rolled_back(summary.rolled_back);
  proto.set_watched_return(summary.watched_return);
  return proto;
}

v1::EndEpisodeResponse ToProto(const EpisodeSummary& summary) {
  v1::EndEpisodeResponse proto;
  proto.set_episode_return(summary.episode_return);
  proto.set_steps(summary.steps);
  proto.set_spikes(summary.spikes);
  proto.set_energy_joules(summary.energy_joules);
  if (summary.learning.has_value()) *proto.mutable_learning() = ToProto(*summary.learning);
  proto.set_awaits_verdict(summary.awaits_verdict);
  return proto;
}

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

// The parts of an answer are written through mutable_*() into the response, so that they are
// allocated on the response's arena.

void ToProto(const Counts& counts, v1::SpikesByStage* proto) {
  proto->set_coder(counts.spikes(Stage::kCoder));
  proto->set_phase(counts.spikes(Stage::kPhase));
  proto->set_query(counts.spikes(Stage::kQuery));
  proto->set_key(counts.spikes(Stage::kKey));
  proto->set_value(counts.spikes(Stage::kValue));
  proto->set_ffn_in(counts.spikes(Stage::kFfnIn));
  proto->set_ffn_hidden(counts.spikes(Stage::kFfnHidden));
  proto->set_readout(counts.spikes(Stage::kReadout));
}

// Sets what each energy model estimates; the fields of models that do not apply stay absent.
void EnergiesToProto(const Counts& counts, const ModelConfig& config, v1::DecisionStats* proto) {
  const double energy = DefaultEnergy(counts, config);
  proto->set_energy_joules(energy);
  proto->set_horowitz_energy_joules(energy);
  if (const auto joules = EstimateEnergy(EnergyModel::kSpike5pj, counts, config)) {
    proto->set_spike_energy_joules(*joules);
  }
  if (const auto joules = EstimateEnergy(EnergyModel::kInt45nm, counts, config)) {
    proto->set_int_energy_joules(*joules);
  }
  if (const auto joules = EstimateEnergy(EnergyModel::kIntSram45nm, counts, config)) {
    proto->set_int_sram_energy_joules(*joules);
  }
}

void ToProto(const Answer& answer, const ModelConfig& config, v1::DecisionStats* proto) {
  const Counts& counts = answer.counts;
  proto->set_spikes(counts.total_spikes());
  proto->set_synaptic_operations(counts.synaptic_operations());
  proto->set_compute_seconds(answer.compute_seconds);
  ToProto(counts, proto->mutable_spikes_by_stage());
  proto->set_accumulates(counts.accumulates);
  proto->set_multiply_accumulates(counts.multiply_accumulates);
  proto->set_attention_products(counts.attention_products);
  proto->set_unusual_observations(answer.unusual_observations);
  proto->set_membrane_updates(counts.membrane_updates);
  proto->set_coder_gains(counts.coder_gains);
  proto->set_layer_norm_elements(counts.layer_norm_elements);
  proto->set_softmax_terms(counts.softmax_terms);
  proto->set_gate_products(counts.gate_products);
  proto->set_integer_multiply_accumulates(counts.integer_multiply_accumulates);
  EnergiesToProto(counts, config, proto);
}

// `Error` is an ActError or an ActResult, which have these fields in common.
template <typename Error>
void SetError(const absl::Status& status, Error* error) {
  error->set_code(static_cast<int>(status.code()));
  error->set_message(std::string(status.message()));
  if (const auto delay = RetryDelay(status)) {
    error->set_retry_after_seconds(absl::ToDoubleSeconds(*delay));
  }
  if (const auto expected = ExpectedDecisionOf(status)) {
    error->set_expected_decision(expected->decision);
    error->set_expected_episode(expected->episode);
    error->set_expected_step(expected->step);
  }
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

v1::WiringVerdict ToProto(const WiringVerdict& verdict, const Policy& policy) {
  v1::WiringVerdict proto;
  proto.set_cause(static_cast<v1::WiringVerdict::Cause>(static_cast<int>(verdict.cause) + 1));
  proto.mutable_elements()->Add(verdict.elements.begin(), verdict.elements.end());
  proto.set_text(WiringText(policy, verdict));
  proto.set_evidence(verdict.evidence);
  return proto;
}

void ToProto(const std::string& session_id, const Answer& answer, const Policy& policy,
             v1::ActResponse* response) {
  response->set_session_id(session_id);
  response->set_step(answer.step);
  ToProto(answer.action, policy.action_space.is_discrete(), response->mutable_action());
  response->mutable_action_probabilities()->Add(answer.probabilities.begin(),
                                                answer.probabilities.end());
  response->set_return_to_go(static_cast<double>(answer.return_to_go));
  if (answer.source != StepSource()) {
    response->mutable_source()->set_kind(static_cast<v1::ActionSource::Kind>(answer.source.kind));
    response->mutable_source()->set_operator_id(answer.source.operator_id);
  }
  if (answer.hold.has_value()) ToProto(*answer.hold, response->mutable_hold());
  ToProto(answer, policy.config, response->mutable_stats());
}

void ToProto(const v1::ActRequest& request, const Step& step, absl::Duration received,
             const SessionEntry& entry, v1::ActResponse* response) {
  const StepOutcome& result = step.result;
  if (result.answer != nullptr) {
    ToProto(request.session_id(), *result.answer, entry.served->policy(), response);
    if (const auto& verdict = entry.agent.session().wiring.verdict) {
      *response->mutable_wiring() = ToProto(*verdict, entry.served->policy());
      response->mutable_wiring()->set_is_safe_action(entry.agent.acts_safely());
    }
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

void ErrorToProto(const absl::Status& status, v1::ActResult* result) {
  result->clear_response();
  SetError(status, result);
}

void ErrorToProto(const v1::ActRequest& request, const absl::Status& status,
                  v1::ActResponse* response) {
  response->Clear();
  response->set_session_id(request.session_id());
  response->set_step(request.step());
  SetError(status, response->mutable_error());
}

}  // namespace spikeserve
