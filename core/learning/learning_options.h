// How an action head learns: the constants of eqs. 4.1 to 4.3, and their defaults.
//
// Plain values; free functions without shared state.
#ifndef CORE_LEARNING_LEARNING_OPTIONS_H_
#define CORE_LEARNING_LEARNING_OPTIONS_H_

#include <array>

#include "absl/status/status.h"
#include "core/action/action_head.h"
#include "core/action/action_space.h"
#include "core/base/enum_names.h"

namespace spikeserve {

// What the postsynaptic factor y of eq. 4.1 is; see postsynaptic.h.
enum class Rule { kPolicyGradient, kHebbian };

// Which return eq. 4.2 judges a decision by: the one that conditioned it, or the one that followed;
// see learner.h.
enum class Modulator { kTarget, kRealized };

// Whose head learns: a private one, or the one that all such sessions of a policy version share.
enum class Scope { kSession, kFleet };

// Names as they stand on the wire and in a stored session; see enum_names.h.
constexpr std::array<EnumName<Rule>, 2> EnumNames(Rule) {
  return {{{Rule::kPolicyGradient, "policy_gradient"}, {Rule::kHebbian, "hebbian"}}};
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
  double learning_rate = DefaultLearningRate(Modulator::kRealized);  // eta of eq. 4.3, > 0
  double trace_decay = 0.9;                                          // lambda of eq. 4.1, in [0, 1]
  double discount = 0.97;      // gamma of the realized return-to-go, in [0, 1]; see learner.h
  double clip = 0.5;           // largest Frobenius norm of one update of the head, > 0
  double max_drift = 2.0;      // largest |W - W_base| / |W_base| a private head may reach, > 0
  double guard_margin = 0.02;  // of a private head's guard, >= 0; see return_guard.h

  // An update a decision, or an update an episode whose deltas are relative to its own returns.
  static constexpr double DefaultLearningRate(Modulator modulator) {
    return modulator == Modulator::kTarget ? 1e-3 : 0.3;
  }

  // INVALID_ARGUMENT names the field, as `learning.FIELD`, what was expected and what came. A
  // policy gradient needs the noise of a sampled action where the space is a Box: the score of a
  // greedy action is zero.
  absl::Status Validate(const ActionSpace& space, const ActionSelection& selection) const;
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_LEARNING_OPTIONS_H_
