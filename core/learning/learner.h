// Three-factor plasticity of one action head (eqs. 4.1 to 4.3), decision by decision.
//
// After every decision E <- lambda E + y (x) r (eq. 4.1; y: postsynaptic.h, r: the readout rates).
// Only weights learn; the head's bias is no synapse and stays. Then, by modulator:
//
// target: delta_t = clip((G_t - mu) / sigma, -1, 1) with the return-to-go G_t that conditioned the
// decision, and dW = eta delta_t E_t at once, its norm clipped. Decision t + 1 uses the new head.
//
// realized: delta_t is judged by the return-to-go that really followed, G_t = R - c_t, with R the
// episode's return and c_t the rewards before decision t. The head moves once, when the episode
// ends, however it ended. Keeping every E_t would grow with the episode, so delta_t is linear:
//   delta_t = (G_t - mu) / (sigma s),   s = max(1, max_t |G_t - mu| / sigma)
//   dW = eta sum_t delta_t E_t = eta / (sigma s) [(R - mu) sum_t E_t - sum_t c_t E_t]
// which needs two sums and the extremes of c_t. Eq. 4.2's range [-1, 1] is kept by s, which scales
// all deltas of the episode alike where a clip would flatten some: credit within the episode keeps
// its proportions. The norm of the whole dW is clipped, since its steps are never formed.
//
// mu and sigma stay fixed within an episode and take in its returns-to-go once it has ended, after
// its update, under either modulator.
//
// Plain values, constant in size whatever the episode's length. Not thread-safe.
#ifndef CORE_LEARNING_LEARNER_H_
#define CORE_LEARNING_LEARNER_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "absl/types/span.h"
#include "core/engine/action_head.h"
#include "core/learning/eligibility_trace.h"
#include "core/learning/head_update.h"
#include "core/learning/learning_options.h"
#include "core/learning/return_statistics.h"
#include "core/model/policy.h"

namespace spikeserve {

// What a session has learned, and what it needs to go on learning bit for bit.
struct Learner {
  std::vector<float> head_delta;  // [act, d]: W - W_base
  ReturnStatistics returns;       // mu and sigma
  EligibilityTrace trace;         // [act, d]; of the running episode, like all that follows
  RewardsBefore rewards_before;
  std::vector<double> trace_sum;     // [act, d]: sum_t E_t; empty unless modulator is realized
  std::vector<double> weighted_sum;  // [act, d]: sum_t c_t E_t; likewise
  int64_t updates = 0;               // applied in this episode
  int64_t rejected = 0;              // refused in this episode

  // A learner that has learned nothing, on `policy`'s own head. `options` must be valid and, like
  // `policy`, the same in every call.
  static Learner New(const LearningOptions& options, const Policy& policy);

  // Eq. 4.1 and, for the target modulator, eqs. 4.2 and 4.3. `readout` [d] is what `choice` was
  // made from, `return_to_go` what conditioned it, `rewards` c_t. What became of the update, where
  // one was due. A refused update that was not finite takes the traces with it.
  std::optional<UpdateOutcome> OnDecision(const LearningOptions& options, const Policy& policy,
                                          const ActionChoice& choice,
                                          absl::Span<const float> readout, double return_to_go,
                                          double rewards);

  // For the realized modulator, eqs. 4.2 and 4.3 over the whole episode.
  std::optional<UpdateOutcome> OnEpisodeEnd(const LearningOptions& options, const Policy& policy,
                                            double episode_return);

  // Makes ready for the next episode: head, mu and sigma stay.
  void StartEpisode(const LearningOptions& options);

  // The head to act with: W_base + head_delta, and the policy's bias.
  Linear Head(const Policy& policy) const;

  // |W - W_base| / |W_base|; where the policy's head is all zero, |W|.
  double Drift(const Policy& policy) const;

 private:
  UpdateOutcome Apply(const LearningOptions& options, const Policy& policy, double factor,
                      absl::Span<const double> direction);
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_LEARNER_H_
