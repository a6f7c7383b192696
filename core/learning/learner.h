// Three-factor plasticity of one action head (eqs. 4.1 to 4.3), applied decision by decision.
//
// Eq. 4.1 runs after every decision: E <- lambda E + y r^T, where r are the readout rates and y is
// the postsynaptic factor (postsynaptic.h). Only the weights learn; the bias of the head is
// constant. The modulator decides which return eqs. 4.2 and 4.3 use, and when they run.
//
// Modulator::kTarget updates the head after every decision:
//   delta_t = clip((G_t - mu) / sigma, -1, 1),   dW = eta delta_t E_t
// G_t is the return-to-go that conditioned the decision. The Frobenius norm of dW is limited. mu
// and sigma start as those of the policy. An episode's undiscounted returns-to-go enter them when
// the episode ends, after its updates.
//
// Modulator::kRealized updates the head once, at the end of the episode:
//   G_t = sum_{k >= t} gamma^{k-t} r_k
//   delta_t = (G_t - mu) / s,   s = max(sigma, sqrt(mean_t (G_t - mu)^2))
//   dW = eta sum_t delta_t E_t = eta / s [sum_k r_k F_k - mu sum_t E_t]
//   F_k = gamma F_{k-1} + E_k
// G_t is the discounted return that followed the decision. Because delta_t is linear in G_t, three
// matrices are enough and no E_t is stored. The clip of eq. 4.2 would need every G_t; instead, s
// keeps the root mean square of the deltas of an episode at most 1 and their proportions unchanged.
// The Frobenius norm of the whole dW is limited. The episode enters mu and sigma before its update,
// so the first episode defines them.
//
// For kRealized, an episode that is truncated rather than terminated is extended: every decision
// after the last one is assumed to earn the mean reward of the episode, which adds
// gamma / (1 - gamma) mean_k r_k to the last reward. Nothing is added if gamma is 1.
//
// Rule::kCorrections has no trace and no modulator: operators teach it (correction.h), and rewards
// only enter mu and sigma.
//
// With `verdict_seconds`, an episode's factors are kept (episode_factors.h) until its rewards are
// known. The episode is then learned from by the same steps, in the same order, so the head is
// equal bit for bit to one that knew them in time.
//
// Plain values; without `verdict_seconds`, their size does not depend on the length of the episode.
// Not thread-safe.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "Eigen/Core"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/action/action_head.h"
#include "core/learning/correction.h"
#include "core/learning/correction_runs.h"
#include "core/learning/episode_factors.h"
#include "core/learning/head_update.h"
#include "core/learning/learning_options.h"
#include "core/learning/return_guard.h"
#include "core/learning/return_statistics.h"
#include "core/model/policy.h"

namespace spikeserve {

// A step that an operator took.
struct OperatorStep {
  const Action& executed;  // in the place of the last decision
  absl::string_view operator_id;
  double time;  // seconds since 1970
};

// What a session has learned, and the state that it needs to continue bit for bit. The vectors are
// flat row-major [act * d] arrays of the shape of W.
struct Learner {
  // Scope::kSession: W - W_base of the private head. Scope::kFleet: the contribution of the running
  // episode to the shared head, zero at the start of each episode.
  Eigen::VectorXf head_delta;
  ReturnStatistics returns;  // mu and sigma
  ReturnGuard guard;         // Scope::kSession only

  // State of the running episode.
  Eigen::VectorXf trace;  // E, the eligibility trace
  EpisodeReturns episode;
  Eigen::VectorXd trace_sum;         // sum_t E_t; empty unless the modulator is kRealized
  Eigen::VectorXd discounted_trace;  // F_k; empty unless the modulator is kRealized
  Eigen::VectorXd credit;            // sum_k r_k F_k; empty unless the modulator is kRealized
  int64_t updates = 0;               // steps of the head that were applied
  int64_t rejected = 0;              // steps of the head that were refused
  bool suspended = false;            // learning was paused, so the episode learns nothing more
  // What OnExecuted and OnOperator need of the last decision; `post` empty: nothing to change.
  Eigen::VectorXf post;           // [act]: y
  Eigen::VectorXf readout;        // [d]: r
  Eigen::VectorXf before_update;  // kTarget only: head_delta before the decision's update
  Corrections corrections;        // kCorrections only
  CorrectionRuns runs;            // kCorrections of Scope::kSession only
  // Scope::kFleet only: who has acted in the running episode, as Contribution::operators.
  std::vector<std::string> operators;

  // LearningOptions::verdict_seconds only.
  std::optional<EpisodeFactors> kept;  // absent: the running episode is learned from at its end
  std::vector<std::shared_ptr<const WaitingEpisode>> waiting;  // oldest first

  // The most steps of which factors are kept, and the most episodes that wait. An episode that goes
  // beyond is learned from at its end.
  static constexpr size_t kMostKept = 4096;
  static constexpr size_t kMostWaiting = 64;

  // Returns a learner for the head W_base + head_delta. `options` must be valid. All later calls
  // take the same `options` and `policy`.
  static Learner New(const LearningOptions& options, const Policy& policy,
                     Eigen::VectorXf head_delta);

  // Applies eq. 4.1, and for kTarget also eqs. 4.2 and 4.3. `rates` [d] are the firing rates that
  // `choice` was made from, `return_to_go` is the return that conditioned it, and `reward` followed
  // the decision before; it is ignored at the first decision of an episode. Returns the outcome of
  // the update of the head, if there was one. An update that is not finite also clears the trace.
  // Allocates no memory once the thread has made a decision of this size.
  std::optional<UpdateOutcome> OnDecision(const LearningOptions& options, const Policy& policy,
                                          const ActionChoice& choice, absl::Span<const float> rates,
                                          double return_to_go, double reward);

  // Changes the last decision to one for `executed`, as if it had been made so: the traces, their
  // sums and, for kTarget, the update of the head follow the action that was executed. `selection`,
  // `logits`, `answered` and `return_to_go` are those of the decision. Does nothing for the rule
  // kHebbian, whose y does not depend on the action. Returns the outcome of the update that
  // replaces the decision's update, if there is one.
  std::optional<UpdateOutcome> OnExecuted(const LearningOptions& options, const Policy& policy,
                                          const ActionSelection& selection,
                                          absl::Span<const float> logits, const Action& answered,
                                          const Action& executed, double return_to_go);

  // Takes an operator's step; the answer of the last decision was chosen from `logits`. For
  // kCorrections, updates the head, or puts `start_delta` back, the head_delta that the session was
  // opened with (empty: zero), if what was learned since does harm. Returns the outcome of the
  // update, if there was one. Does nothing a second time.
  std::optional<UpdateOutcome> OnOperator(const LearningOptions& options, const Policy& policy,
                                          absl::Span<const float> logits, const OperatorStep& step,
                                          const Eigen::VectorXf& start_delta);

  // Takes what an operator has taught a private head since then out of it (correction_runs.h), and
  // begins a new guard, as the old one may have what was taken out. Returns the updates that were;
  // nullopt, and changes nothing, if they are not known one by one any more.
  std::optional<int64_t> UndoCorrections(const LearningOptions& options, const Policy& policy,
                                         absl::string_view operator_id, double since);

  // Takes a step of which only the `reward` of the action before is known: the reward belongs to
  // the decisions before it, and the traces decay, but no activity enters them.
  void OnSkipped(const LearningOptions& options, double reward);

  // Takes the `reward` of the last decision. `terminated` is false if the episode was truncated.
  // For kRealized, applies eqs. 4.2 and 4.3 over the whole episode. Returns the outcome of the
  // update of the head, if there was one.
  std::optional<UpdateOutcome> OnEpisodeEnd(const LearningOptions& options, const Policy& policy,
                                            double reward, bool terminated);

  // Lets the running episode, which the `reward` of its last decision ends, wait for its verdict as
  // `ended`, which lacks its factors. Returns false, and does nothing, if OnEpisodeEnd() is to
  // learn from it now.
  bool AwaitVerdict(double reward, WaitingEpisode ended);
  // Takes the place of the running episode by that of `factors`, which OnEpisodeEnd() ends with the
  // last of their rewards.
  void Recall(const LearningOptions& options, const EpisodeFactors& factors);
  // Returns the steps of which factors are kept.
  size_t kept_steps() const;

  // Scope::kSession: passes the return of an episode to the guard. Returns true if the guard
  // restored an earlier head.
  bool Watch(const LearningOptions& options, double episode_return) {
    if (options.rule == Rule::kCorrections) {
      if (corrections.in_episode > 0) return false;  // the return is not the head's alone
      const bool replaced = guard.OnEpisodeAlone(episode_return, options.guard_margin, &head_delta);
      if (replaced) runs.Forget();
      return replaced;
    }
    if (guard.on_probation) head_delta = guard.good;  // a head that is measured does not learn
    return guard.OnEpisode(episode_return, options.guard_margin, &head_delta);
  }

  // Clears the state of the episode that has ended. Scope::kFleet: also clears `head_delta`, which
  // the shared head has received.
  void StartEpisode(const LearningOptions& options);

 private:
  void AddReward(double reward);
  void NoteOperator(absl::string_view operator_id);
  // Adds a decision with the factors `post` and `readout`, which the reward of the one before comes
  // with.
  void AddDecision(const LearningOptions& options, double reward, absl::Span<const float> post_y,
                   absl::Span<const float> rates);
  // Exchanges y of the last decision in the traces and their sums.
  void ChangeAction(absl::Span<const float> from, absl::Span<const float> to,
                    absl::Span<const float> rates);
  void AddGap(const LearningOptions& options, double reward);
  // Keeps a step instead of learning from it. Returns false if no more steps are kept: the traces
  // then have those of the episode that were.
  bool Keep(const LearningOptions& options, double reward, StepFactors step);
  void Replay(const LearningOptions& options, const EpisodeFactors& factors);
  // kTarget: applies eqs. 4.2 and 4.3 to the trace.
  UpdateOutcome ApplyTarget(const LearningOptions& options, const Policy& policy,
                            double return_to_go);
  // `Direction` is a vector of float or double.
  template <typename Direction>
  UpdateOutcome Apply(const LearningOptions& options, const Policy& policy, double factor,
                      const Direction& direction);
};

// Returns the head of `policy` with the weights W_base + head_delta; `head_delta` is [act * d].
Linear HeadWith(const Policy& policy, const Eigen::VectorXf& head_delta);

// Writes the same into a head of this policy, whose memory is reused.
void HeadWith(const Policy& policy, const Eigen::VectorXf& head_delta, Linear* head);

// Returns |W_base|, the unit of drift, or 1 if the head of the policy is all zero.
double BaseNorm(const Policy& policy);

}  // namespace spikeserve
