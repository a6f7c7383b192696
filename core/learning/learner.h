// Three-factor plasticity of one action head (eqs. 4.1 to 4.3), decision by decision.
//
// After every decision E <- lambda E + y (x) r (eq. 4.1; y: postsynaptic.h, r: the readout rates).
// Only weights learn; the head's bias is no synapse and stays. Then, by modulator:
//
// target: delta_t = clip((G_t - mu) / sigma, -1, 1) with the return-to-go G_t that conditioned the
// decision, and dW = eta delta_t E_t at once, its norm clipped. mu and sigma start as the policy's
// and take in the episode's undiscounted returns-to-go once it has ended, after its updates.
//
// realized: delta_t is judged by the return that really followed, discounted by gamma,
// G_t = sum_{k >= t} gamma^{k-t} r_k, so that a decision answers for what it can have caused. The
// head moves once, when the episode ends. Keeping every E_t would grow with the episode, so delta_t
// is linear:
//   delta_t = (G_t - mu) / s,   s = max(sigma, sqrt(mean_t (G_t - mu)^2))
//   dW = eta sum_t delta_t E_t = eta / s [sum_k r_k F_k - mu sum_t E_t],   F_k = gamma F_{k-1} +
//   E_k
// which needs three matrices. In place of eq. 4.2's clip, which would need every G_t, s keeps the
// root mean square of an episode's deltas within 1 and the proportions of credit as they are. The
// norm of the whole dW is clipped. mu and sigma take in the episode before its update; the first
// episode defines them.
// Where an episode is cut off rather than terminated, it would have gone on: beyond its last
// decision stand further rewards, all equal to its mean reward, which add
// gamma / (1 - gamma) mean_k r_k to the last reward (nothing where gamma is 1).
//
// Plain values, constant in size whatever the episode's length. Not thread-safe.
#ifndef CORE_LEARNING_LEARNER_H_
#define CORE_LEARNING_LEARNER_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "absl/types/span.h"
#include "core/action/action_head.h"
#include "core/learning/eligibility_trace.h"
#include "core/learning/head_update.h"
#include "core/learning/learning_options.h"
#include "core/learning/return_guard.h"
#include "core/learning/return_statistics.h"
#include "core/model/policy.h"

namespace spikeserve {

// What a session has learned, and what it needs to go on learning bit for bit.
struct Learner {
  // [act, d]. Scope session: W - W_base of the private head. Scope fleet: what the running episode
  // will give to the shared head, zero as it starts.
  std::vector<float> head_delta;
  ReturnStatistics returns;  // mu and sigma
  ReturnGuard guard;         // scope session
  EligibilityTrace trace;    // [act, d]; of the running episode, like all that follows
  EpisodeReturns episode;
  std::vector<double> trace_sum;         // [act, d]: sum_t E_t; empty unless modulator is realized
  std::vector<double> discounted_trace;  // [act, d]: F_k; likewise
  std::vector<double> credit;            // [act, d]: sum_k r_k F_k; likewise
  int64_t updates = 0;                   // applied in this episode
  int64_t rejected = 0;                  // refused in this episode
  bool suspended = false;                // learning was paused: this episode teaches nothing more

  // A learner on `policy`'s own head plus `head_delta` [act, d]. `options` must be valid and, like
  // `policy`, the same in every call.
  static Learner New(const LearningOptions& options, const Policy& policy,
                     std::vector<float> head_delta);

  // Eq. 4.1 and, for the target modulator, eqs. 4.2 and 4.3. `readout` [d] is what `choice` was
  // made from, `return_to_go` what conditioned it, `reward` that of the decision before, ignored at
  // an episode's first. What became of the update, where one was due. A refused update that was not
  // finite takes the traces with it.
  std::optional<UpdateOutcome> OnDecision(const LearningOptions& options, const Policy& policy,
                                          const ActionChoice& choice,
                                          absl::Span<const float> readout, double return_to_go,
                                          double reward);

  // The last decision earned `reward`; `terminated` unless the episode was cut off. For the
  // realized modulator, eqs. 4.2 and 4.3 over the whole episode.
  std::optional<UpdateOutcome> OnEpisodeEnd(const LearningOptions& options, const Policy& policy,
                                            double reward, bool terminated);

  // Scope session: lets the guard see the episode's return. True where the head was rolled back.
  bool Watch(const LearningOptions& options, double episode_return) {
    return guard.OnEpisode(episode_return, options.guard_margin, &head_delta);
  }

  // Makes ready for the next episode: what was learned stays. Scope fleet: `head_delta` starts
  // empty, its content having been handed over.
  void StartEpisode(const LearningOptions& options);

 private:
  void AddReward(double reward);
  UpdateOutcome Apply(const LearningOptions& options, const Policy& policy, double factor,
                      absl::Span<const double> direction);
};

// The head of `policy` with W_base + head_delta for its weights; `head_delta` [act, d].
Linear HeadWith(const Policy& policy, absl::Span<const float> head_delta);

// |W_base|, what drift is measured against; 1 where the policy's head is all zero.
double BaseNorm(const Policy& policy);

}  // namespace spikeserve

#endif  // CORE_LEARNING_LEARNER_H_
