// Acrobot-v1: swing the tip of a two-link pendulum above the bar that it hangs from, with a torque
// of -1 (action 0), 0 (1) or 1 N m (2) at the elbow.
//
// R. S. Sutton, A. G. Barto, "Reinforcement Learning: An Introduction" (the dynamics of the book,
// not of the NIPS paper), in Gymnasium's form: one classical Runge-Kutta step of 0.2 s.
// - State [4]: angle of the first link from hanging, angle of the second link from the first [rad,
//   in [-pi, pi]], and their angular velocities [rad/s, within +-4 pi and +-9 pi].
// - Observation [6]: cosine and sine of the first angle, cosine and sine of the second angle, the
//   two velocities.
// - Reward: -1 per step, but 0 for the step that reaches the goal.
// - Termination: the tip is more than one link length above the bar. Time limit: 500 steps.
#ifndef CORE_ENVIRONMENT_ACROBOT_H_
#define CORE_ENVIRONMENT_ACROBOT_H_

#include <vector>

#include "absl/strings/string_view.h"
#include "core/environment/classic_control.h"

namespace spikeserve {

// Physical constants, with Gymnasium's names for them; the defaults are Gymnasium's.
struct AcrobotParameters {
  double m1 = 1.0;       // kg, mass of the first link
  double m2 = 1.0;       // kg, mass of the second link
  double l1 = 1.0;       // m, length of the first link
  double lc1 = 0.5;      // m, from the bar to the first link's centre of mass
  double lc2 = 0.5;      // m, from the elbow to the second link's centre of mass
  double i1 = 1.0;       // kg m^2, moment of inertia of the first link
  double i2 = 1.0;       // kg m^2, moment of inertia of the second link
  double gravity = 9.8;  // m/s^2
  double torque = 1.0;   // N m
};

class Acrobot final : public ClassicControl {
 public:
  static constexpr absl::string_view kId = "Acrobot-v1";

  explicit Acrobot(const AcrobotParameters& parameters = {});

  double Advance(const Action& action, absl::Span<double> state) const override;
  bool IsTerminal(absl::Span<const double> state) const override;

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override;
  std::vector<float> Observe(absl::Span<const double> state) const override;

  AcrobotParameters parameters_;
};

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_ACROBOT_H_
