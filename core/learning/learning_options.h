// The options of eqs. 4.1 to 4.3: how an action head learns.
//
// Plain values; free functions without shared state.
#pragma once

#include <array>

#include "absl/status/status.h"
#include "core/action/action_head.h"
#include "core/action/action_space.h"
#include "core/base/enum_names.h"

namespace spikeserve {

// Selects the postsynaptic factor y of eq. 4.1 (postsynaptic.h), or learning from the steps of
// operators alone (correction.h).
enum class Rule { kPolicyGradient, kHebbian, kHebbianAction, kCorrections };

// Selects the return G of eq. 4.2: the return-to-go that conditioned the decision (target), or the
// return that followed it (realized); see learner.h.
enum class Modulator { kTarget, kRealized };

// Selects the head that learns: a private head of the session, or the head that all fleet sessions
// of the policy version share.
enum class Scope { kSession, kFleet };

// Names on the wire and in a stored session; see enum_names.h.
constexpr std::array<EnumName<Rule>, 4> EnumNames(Rule) {
  return {{{Rule::kPolicyGradient, "policy_gradient"},
           {Rule::kHebbian, "hebbian"},
           {Rule::kHebbianAction, "hebbian_action"},
           {Rule::kCorrections, "corrections"}}};
}
constexpr std::array<EnumName<Modulator>, 2> EnumNames(Modulator) {
  return {{{Modulator::kTarget, "target"}, {Modulator::kRealized, "realized"}}};
}
constexpr std::array<EnumName<Scope>, 2> EnumNames(Scope) {
  return {{{Scope::kSession, "session"}, {Scope::kFleet, "fleet"}}};
}

struct LearningOptions {
  Scope scope = Scope::kSession;
  Rule rule = Rule::kPolicyGradient;
  Modulator modulator = Modulator::kRealized;
  // eta of eq. 4.3, or of correction.h, > 0
  double learning_rate = DefaultLearningRate(Rule::kPolicyGradient, Modulator::kRealized);
  double trace_decay = 0.9;    // lambda of eq. 4.1, in [0, 1]
  double discount = 0.97;      // gamma of the realized return-to-go, in [0, 1]; see learner.h
  double clip = 0.5;           // largest Frobenius norm of one update of the head, > 0
  double max_drift = 2.0;      // largest |W - W_base| / |W_base| of a private head, > 0
  double guard_margin = 0.02;  // of the guard of a private head, >= 0; see return_guard.h
  // How long an ended episode waits for its verdict before it is learned from as it is, in
  // [0, kLongestWait]; 0: it is learned from at its end.
  double verdict_seconds = 0.0;

  static constexpr double kLongestWait = 3600.0;

  // target updates the head after every decision. realized updates it once an episode, and its
  // deltas are relative to the returns of that episode, so its steps are larger. A correction's
  // step is relative to the one that would repeat the operator's action.
  static constexpr double DefaultLearningRate(Rule rule, Modulator modulator) {
    if (rule == Rule::kCorrections) return 0.5;
    return modulator == Modulator::kTarget ? 1e-3 : 0.3;
  }

  // Returns INVALID_ARGUMENT with the text `learning.FIELD: expected X, received Y` for the first
  // invalid field. kPolicyGradient on a Box requires sampled actions, because the score of a greedy
  // action is zero.
  absl::Status Validate(const ActionSpace& space, const ActionSelection& selection) const;
};

}  // namespace spikeserve
