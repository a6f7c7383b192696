// Lists the members of every struct in a session's binary form, in order.
//
// The writer and the reader share these lists. Changing a list changes the format.
#pragma once

#include <concepts>
#include <cstddef>
#include <type_traits>

#include "core/session/session.h"

namespace spikeserve {

// Each function below calls `visit(name, member)` for every member in order. `T` is S or const S.
template <typename T, typename S>
concept Is = std::same_as<std::remove_const_t<T>, S>;

template <Is<Action> T, typename Visitor>
void VisitFields(T& action, Visitor&& visit) {
  visit("discrete", action.discrete);
  visit("continuous", action.continuous);
}

template <Is<Timestep> T, typename Visitor>
void VisitFields(T& timestep, Visitor&& visit) {
  visit("return_to_go", timestep.return_to_go);
  visit("observation", timestep.observation);
  visit("action", timestep.action);
}

template <Is<Counts> T, typename Visitor>
void VisitFields(T& counts, Visitor&& visit) {
  visit("spikes_by_stage", counts.spikes_by_stage);
  visit("accumulates", counts.accumulates);
  visit("multiply_accumulates", counts.multiply_accumulates);
  visit("attention_products", counts.attention_products);
  visit("integer_multiply_accumulates", counts.integer_multiply_accumulates);
  visit("membrane_updates", counts.membrane_updates);
  visit("coder_gains", counts.coder_gains);
  visit("layer_norm_elements", counts.layer_norm_elements);
  visit("softmax_terms", counts.softmax_terms);
  visit("gate_products", counts.gate_products);
}

// The counts of integer arithmetic.
inline size_t MoreFields(const Counts& counts) { return counts.weight_bytes > 0 ? 6 : 0; }
template <Is<Counts> T, typename Visitor>
void VisitMoreFields(T& counts, Visitor&& visit) {
  visit("membrane_ticks", counts.membrane_ticks);
  visit("membrane_leaks", counts.membrane_leaks);
  visit("wide_multiply_accumulates", counts.wide_multiply_accumulates);
  visit("attention_scalings", counts.attention_scalings);
  visit("weight_bytes", counts.weight_bytes);
  visit("attention_bytes", counts.attention_bytes);
}

template <Is<Answer> T, typename Visitor>
void VisitFields(T& answer, Visitor&& visit) {
  visit("step", answer.step);
  visit("action", answer.action);
  visit("probabilities", answer.probabilities);
  visit("return_to_go", answer.return_to_go);
  visit("counts", answer.counts);
  visit("unusual_observations", answer.unusual_observations);
  visit("compute_seconds", answer.compute_seconds);
  visit("logits", answer.logits);
}

template <Is<StepSource> T, typename Visitor>
void VisitFields(T& source, Visitor&& visit) {
  visit("kind", source.kind);
  visit("operator_id", source.operator_id);
}

template <Is<Hold> T, typename Visitor>
void VisitFields(T& hold, Visitor&& visit) {
  visit("id", hold.id);
  visit("reason", hold.reason);
}

// Of an action that the policy has not chosen.
inline size_t MoreFields(const Answer& answer) {
  if (answer.hold.has_value()) return 2;
  return answer.source != StepSource() ? 1 : 0;
}
template <Is<Answer> T, typename Visitor>
void VisitMoreFields(T& answer, Visitor&& visit) {
  visit("source", answer.source);
  visit("hold", answer.hold);
}

template <Is<ActionSelection> T, typename Visitor>
void VisitFields(T& selection, Visitor&& visit) {
  visit("sample", selection.sample);
  visit("temperature", selection.temperature);
}

template <Is<LearningOptions> T, typename Visitor>
void VisitFields(T& options, Visitor&& visit) {
  visit("scope", options.scope);
  visit("rule", options.rule);
  visit("modulator", options.modulator);
  visit("learning_rate", options.learning_rate);
  visit("trace_decay", options.trace_decay);
  visit("discount", options.discount);
  visit("clip", options.clip);
  visit("max_drift", options.max_drift);
  visit("guard_margin", options.guard_margin);
}

template <Is<ReturnStatistics> T, typename Visitor>
void VisitFields(T& statistics, Visitor&& visit) {
  visit("mean", statistics.mean);
  visit("variance", statistics.variance);
  visit("decisions", statistics.decisions);
}

template <Is<EpisodeReturns> T, typename Visitor>
void VisitFields(T& episode, Visitor&& visit) {
  visit("decisions", episode.decisions);
  visit("rewards", episode.rewards);
  visit("returns", episode.returns);
  visit("squares", episode.squares);
  visit("weights", episode.weights);
  visit("weights2", episode.weights2);
  visit("projected", episode.projected);
}

template <Is<WindowLevel> T, typename Visitor>
void VisitFields(T& level, Visitor&& visit) {
  visit("mean", level.mean);
  visit("error", level.error);
}

template <Is<ReturnGuard> T, typename Visitor>
void VisitFields(T& guard, Visitor&& visit) {
  visit("returns", guard.returns);
  visit("beginning", guard.beginning);
  visit("good", guard.good);
  visit("has_reference", guard.has_reference);
  visit("reference", guard.reference);
  visit("last", guard.last);
  visit("on_probation", guard.on_probation);
  visit("rollbacks", guard.rollbacks);
}

template <Is<Learner> T, typename Visitor>
void VisitFields(T& learner, Visitor&& visit) {
  visit("head_delta", learner.head_delta);
  visit("returns", learner.returns);
  visit("guard", learner.guard);
  visit("trace", learner.trace);
  visit("episode", learner.episode);
  visit("trace_sum", learner.trace_sum);
  visit("discounted_trace", learner.discounted_trace);
  visit("credit", learner.credit);
  visit("updates", learner.updates);
  visit("rejected", learner.rejected);
  visit("suspended", learner.suspended);
  visit("post", learner.post);
  visit("readout", learner.readout);
  visit("before_update", learner.before_update);
}

template <Is<EpisodeEnd> T, typename Visitor>
void VisitFields(T& end, Visitor&& visit) {
  visit("reward", end.reward);
  visit("terminated", end.terminated);
  visit("target_return", end.target_return);
  visit("truncated", end.truncated);
  visit("observation", end.observation);
  visit("executed_action", end.executed_action);
}

template <Is<LearningSummary> T, typename Visitor>
void VisitFields(T& summary, Visitor&& visit) {
  visit("scope", summary.scope);
  visit("updates", summary.updates);
  visit("rejected", summary.rejected);
  visit("head_drift", summary.head_drift);
  visit("returns", summary.returns);
  visit("rolled_back", summary.rolled_back);
  visit("watched_return", summary.watched_return);
}

template <Is<EpisodeSummary> T, typename Visitor>
void VisitFields(T& summary, Visitor&& visit) {
  visit("episode_return", summary.episode_return);
  visit("steps", summary.steps);
  visit("spikes", summary.spikes);
  visit("energy_joules", summary.energy_joules);
  visit("learning", summary.learning);
}

template <Is<EndedEpisode> T, typename Visitor>
void VisitFields(T& ended, Visitor&& visit) {
  visit("end", ended.end);
  visit("summary", ended.summary);
}

template <Is<SessionOptions> T, typename Visitor>
void VisitFields(T& options, Visitor&& visit) {
  visit("policy", options.policy);
  visit("version", options.version);
  visit("target_return", options.target_return);
  visit("seed", options.seed);
  visit("action_selection", options.action_selection);
  visit("labels", options.labels);
  visit("tenant", options.tenant);
  visit("learning", options.learning);
  visit("head_delta", options.head_delta);
  visit("durability", options.durability);
  visit("recording", options.recording);
  visit("policy_sha256", options.policy_sha256);
}

// The session itself has the other members of a contribution.
template <Is<Contribution> T, typename Visitor>
void VisitFields(T& contribution, Visitor&& visit) {
  visit("episode", contribution.episode);
  visit("delta", contribution.delta);
  visit("episode_return", contribution.episode_return);
  visit("summary", contribution.summary);
}

template <Is<WiringHypothesis> T, typename Visitor>
void VisitFields(T& hypothesis, Visitor&& visit) {
  visit("number", hypothesis.number);
  visit("evidence", hypothesis.evidence);
  visit("total", hypothesis.total);
}

template <Is<WiringVerdict> T, typename Visitor>
void VisitFields(T& verdict, Visitor&& visit) {
  visit("cause", verdict.cause);
  visit("elements", verdict.elements);
  visit("evidence", verdict.evidence);
}

template <Is<WiringState> T, typename Visitor>
void VisitFields(T& wiring, Visitor&& visit) {
  visit("is_open", wiring.is_open);
  visit("steps", wiring.steps);
  visit("unusual", wiring.unusual);
  visit("hypotheses", wiring.hypotheses);
  visit("runs", wiring.runs);
  visit("verdict", wiring.verdict);
}

template <Is<Session> T, typename Visitor>
void VisitFields(T& session, Visitor&& visit) {
  visit("id", session.id);
  visit("options", session.options);
  visit("episode", session.episode);
  visit("step", session.step);
  visit("target_return", session.target_return);
  visit("return_to_go", session.return_to_go);
  visit("episode_return", session.episode_return);
  visit("episode_spikes", session.episode_spikes);
  visit("episode_energy_joules", session.episode_energy_joules);
  visit("history", session.history);
  visit("last_answer", session.last_answer);
  if constexpr (std::is_const_v<T>) {
    // Written until the next decision only, so that the value of a session does not depend on it.
    const auto last_end = session.step == 0 ? session.last_end : decltype(session.last_end)();
    visit("last_end", last_end);
  } else {
    visit("last_end", session.last_end);
  }
  visit("decisions", session.decisions);
  visit("spikes", session.spikes);
  visit("energy_joules", session.energy_joules);
  visit("learner", session.learner);
  visit("pending", session.pending);
}

template <Is<Seat> T, typename Visitor>
void VisitFields(T& seat, Visitor&& visit) {
  visit("operator_id", seat.operator_id);
  visit("lease_id", seat.lease_id);
  visit("lease_seconds", seat.lease_seconds);
  visit("left_seconds", seat.left_seconds);
  visit("action", seat.action);
  visit("steps", seat.steps);
  visit("agreed_steps", seat.agreed_steps);
}

inline size_t MoreFields(const Session& session) {
  if (session.seat.has_value()) return 3;
  if (session.step > 0 && session.executed_source != StepSource()) return 2;
  return session.wiring != WiringState() ? 1 : 0;
}
template <Is<Session> T, typename Visitor>
void VisitMoreFields(T& session, Visitor&& visit) {
  visit("wiring", session.wiring);
  visit("executed_source", session.executed_source);
  visit("seat", session.seat);
}

// Is satisfied by types that have an overload of VisitMoreFields(): optional members at the end, of
// which the first MoreFields() are written, so that releases which do not know the others can read
// these.
template <typename T>
concept MayHaveMoreFields = requires(T& value) {
  VisitMoreFields(value, [](const char*, auto&) {});
};

// Is satisfied by types that have an overload of VisitFields().
template <typename T>
concept HasFields = requires(T& value) {
  VisitFields(value, [](const char*, auto&) {});
};

}  // namespace spikeserve
