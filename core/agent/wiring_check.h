// Tests whether the observations of a session are wired as in the training data, by the policy's
// WiringModel.
//
//   WiringCheck check(policy);
//   check.BeginEpisode();
//   check.OnStep(observation, /*action=*/{});       // step 0
//   check.OnStep(observation, previous_action);     // encoded, as it was executed
//   if (check.verdict().has_value()) ...
//
// In the first steps of each episode, and again from time to time, each hypothesis (two elements
// exchanged, another sign, degrees, a delay) collects evidence while it explains the steps better
// than the wiring of the training data does. Evidence counts only as far as that wiring makes a
// step unusual, so that a session in which nothing happens gets no verdict. A hypothesis that the
// steps contradict is not computed any more, so that a clean session costs little.
//
// Not thread-safe. The results have equal bits on every processor.
#ifndef CORE_AGENT_WIRING_CHECK_H_
#define CORE_AGENT_WIRING_CHECK_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/types/span.h"
#include "core/base/enum_names.h"
#include "core/model/policy.h"
#include "core/model/wiring_model.h"

namespace spikeserve {

enum class WiringCause { kExchanged, kSign, kUnit, kStuck, kDelay, kDynamics };
inline constexpr size_t kWiringCauses = 6;

// Names in metrics and on pages.
constexpr std::array<EnumName<WiringCause>, kWiringCauses> EnumNames(WiringCause) {
  return {{{WiringCause::kExchanged, "exchanged"},
           {WiringCause::kSign, "sign"},
           {WiringCause::kUnit, "unit"},
           {WiringCause::kStuck, "stuck"},
           {WiringCause::kDelay, "delay"},
           {WiringCause::kDynamics, "dynamics"}}};
}

// What follows from a verdict.
enum class WiringResponse { kCount, kWarn, kSafe };

// Names in labels of sessions and on command lines.
constexpr std::array<EnumName<WiringResponse>, 3> EnumNames(WiringResponse) {
  return {{{WiringResponse::kCount, "count"},
           {WiringResponse::kWarn, "warn"},
           {WiringResponse::kSafe, "safe"}}};
}

// The label that holds the WiringResponse that a session asked for.
inline constexpr char kWiringLabel[] = "wiring";

struct WiringVerdict {
  WiringCause cause = WiringCause::kDynamics;
  std::vector<int> elements;  // indices, from 0
  std::string text;           // for people
  double evidence = 0.0;      // ln of the likelihood ratio to a correct wiring; 0 for kStuck

  friend bool operator==(const WiringVerdict&, const WiringVerdict&) = default;
};

class WiringCheck {
 public:
  // REQUIRES: `policy` has a wiring model, and outlives this object.
  explicit WiringCheck(const Policy& policy);

  void BeginEpisode();
  // Takes the next observation [obs] of the episode, in environment units. `action` [act] was
  // executed before it, as ActionSpace::Encode writes it; empty if that or the observation before
  // is unknown. Returns whether a verdict begins.
  bool OnStep(absl::Span<const float> observation, absl::Span<const float> action);

  // Returns the cause that explains the last steps best; absent while nothing speaks against the
  // wiring. A verdict is withdrawn when the steps contradict it.
  const std::optional<WiringVerdict>& verdict() const { return verdict_; }

 private:
  struct Hypothesis {
    WiringCause cause;
    size_t i = 0, j = 0;    // elements
    double evidence = 0.0;  // not negative
    double total = 0.0;     // ln of the likelihood ratio since the window began
  };

  void OpenWindow();
  // Compares all hypotheses for the step from before_ to `observation`.
  void Compare(absl::Span<const float> observation, absl::Span<const float> action);
  struct Fit {
    double surprise;  // of the step
    double distance;  // of its observation
  };
  // Returns how a hypothesis (null: the training data's wiring) explains the step.
  Fit Explain(const Hypothesis* hypothesis, absl::Span<const float> observation,
              absl::Span<const float> action) const;
  bool IsPlausible(const Hypothesis& hypothesis, absl::Span<const float> observation) const;
  void Judge();
  void CountRuns(absl::Span<const float> observation);
  // Returns "observation[2] (pole_angle)".
  std::string Named(size_t element) const;
  void SetVerdict(WiringCause cause, std::vector<int> elements, double evidence);

  const Policy& policy_;
  const std::shared_ptr<const WiringModel> model_;
  std::vector<float> before_;           // [obs], the observation before; empty: unknown
  std::vector<float> action_before_;    // [act], the action before that; empty: unknown
  bool is_open_ = false;                // a window is open
  std::vector<Hypothesis> hypotheses_;  // of the window, without those that were given up
  double unusual_ = 0.0;                // evidence that the dynamics are others
  int64_t window_steps_ = 0;
  int64_t steps_until_window_ = 0;
  std::vector<int64_t> runs_;  // [obs], steps in which an element has not changed
  std::optional<WiringVerdict> verdict_;
};

}  // namespace spikeserve

#endif  // CORE_AGENT_WIRING_CHECK_H_
