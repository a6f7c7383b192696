// Lists the members of every struct in a session's binary form, in order.
//
// The writer and the reader share these lists. Changing a list changes the format.
#pragma once

#include <cstddef>
#include <type_traits>

#include "core/base/fields.h"
#include "core/session/session.h"

namespace spikeserve {

SPIKESERVE_FIELDS(Action, discrete, continuous)

SPIKESERVE_FIELDS(Timestep, return_to_go, observation, action)

SPIKESERVE_FIELDS(Counts, spikes_by_stage, accumulates, multiply_accumulates, attention_products,
                  integer_multiply_accumulates, membrane_updates, coder_gains, layer_norm_elements,
                  softmax_terms, gate_products)

// The counts of integer arithmetic.
inline size_t MoreFields(const Counts& counts) { return counts.weight_bytes > 0 ? 6 : 0; }
SPIKESERVE_MORE_FIELDS(Counts, driven_neurons, membrane_leaks, wide_multiply_accumulates,
                       attention_scalings, weight_bytes, attention_bytes)

SPIKESERVE_FIELDS(Answer, step, action, probabilities, return_to_go, counts, unusual_observations,
                  compute_seconds, logits)

SPIKESERVE_FIELDS(StepSource, kind, operator_id)

SPIKESERVE_FIELDS(Hold, id, reason)

// Of an action that the policy has not chosen.
inline size_t MoreFields(const Answer& answer) {
  if (answer.hold.has_value()) return 2;
  return answer.source != StepSource() ? 1 : 0;
}
SPIKESERVE_MORE_FIELDS(Answer, source, hold)

SPIKESERVE_FIELDS(ActionSelection, sample, temperature)

SPIKESERVE_FIELDS(LearningOptions, scope, rule, modulator, learning_rate, trace_decay, discount,
                  clip, max_drift, guard_margin)
inline size_t MoreFields(const LearningOptions& options) {
  return options.verdict_seconds > 0.0 ? 1 : 0;
}
SPIKESERVE_MORE_FIELDS(LearningOptions, verdict_seconds)

SPIKESERVE_FIELDS(ReturnStatistics, mean, variance, decisions)

SPIKESERVE_FIELDS(EpisodeReturns, decisions, rewards, returns, squares, weights, weights2,
                  projected)

SPIKESERVE_FIELDS(WindowLevel, mean, error)

SPIKESERVE_FIELDS(ReturnGuard, returns, beginning, good, has_reference, reference, last,
                  on_probation, rollbacks)

SPIKESERVE_FIELDS(Learner, head_delta, returns, guard, trace, episode, trace_sum, discounted_trace,
                  credit, updates, rejected, suspended, post, readout, before_update)

SPIKESERVE_FIELDS(Corrections, steps, in_episode, measured, error, start_error, size)

SPIKESERVE_FIELDS(CorrectionRun, operator_id, began, ended, updates, before, measured)

SPIKESERVE_FIELDS(CorrectionRuns, runs, forgotten)

SPIKESERVE_FIELDS(StepFactors, post, executed, readout)

SPIKESERVE_FIELDS(EpisodeFactors, steps, rewards)

SPIKESERVE_FIELDS(WaitingEpisode, episode, factors, terminated, target_return, until)

inline size_t MoreFields(const Learner& learner) {
  if (learner.kept.has_value() || !learner.waiting.empty()) return 5;
  if (!learner.operators.empty()) return 3;
  if (!learner.runs.runs.empty() || learner.runs.forgotten != 0.0) return 2;
  return learner.corrections == Corrections() ? 0 : 1;
}
SPIKESERVE_MORE_FIELDS(Learner, corrections, runs, operators, kept, waiting)

SPIKESERVE_FIELDS(EpisodeEnd, reward, terminated, target_return, truncated, observation,
                  executed_action)

SPIKESERVE_FIELDS(LearningSummary, scope, updates, rejected, head_drift, returns, rolled_back,
                  watched_return)

SPIKESERVE_FIELDS(EpisodeSummary, episode_return, steps, spikes, energy_joules, learning)
inline size_t MoreFields(const EpisodeSummary& summary) { return summary.awaits_verdict ? 1 : 0; }
SPIKESERVE_MORE_FIELDS(EpisodeSummary, awaits_verdict)

SPIKESERVE_FIELDS(EndedEpisode, end, summary)

SPIKESERVE_FIELDS(SessionOptions, policy, version, target_return, seed, action_selection, labels,
                  tenant, learning, head_delta, durability, recording, policy_sha256)

// The session itself has the other members of a contribution.
SPIKESERVE_FIELDS(Contribution, episode, delta, episode_return, summary)
inline size_t MoreFields(const Contribution& contribution) {
  return contribution.operators.empty() ? 0 : 1;
}
SPIKESERVE_MORE_FIELDS(Contribution, operators)

SPIKESERVE_FIELDS(WiringHypothesis, number, evidence, total)

SPIKESERVE_FIELDS(WiringVerdict, cause, elements, evidence)

SPIKESERVE_FIELDS(WiringState, is_open, steps, unusual, hypotheses, runs, verdict)

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

SPIKESERVE_FIELDS(Seat, operator_id, lease_id, lease_seconds, left_seconds, action, steps,
                  agreed_steps)

SPIKESERVE_FIELDS(Verdict, episode, id, digest, episode_return, learning)

inline size_t MoreFields(const Session& session) {
  if (session.interventions > 0) return 5;
  if (!session.verdicts.empty()) return 4;
  if (session.seat.has_value()) return 3;
  if (session.step > 0 && session.executed_source != StepSource()) return 2;
  return session.wiring != WiringState() ? 1 : 0;
}
SPIKESERVE_MORE_FIELDS(Session, wiring, executed_source, seat, verdicts, interventions)

}  // namespace spikeserve
