// Pendulum-v1: swing a pendulum up and balance it with a torque in [-2, 2] N m, which is too weak
// to lift it directly.
//
// Gymnasium's form: semi-implicit Euler steps of 0.05 s. The action is float32. The acceleration by
// the torque and the cost of the torque are computed in float32 too, as NumPy does.
// - State [2]: angle from upright [rad, not wrapped], angular velocity [rad/s, in [-8, 8]].
// - Observation [3]: cosine and sine of the angle, angular velocity.
// - Reward: -(angle^2 + 0.1 velocity^2 + 0.001 torque^2), of the state before the step, with the
//   angle wrapped to [-pi, pi).
// - Termination: never. Time limit: 200 steps.
#ifndef CORE_ENVIRONMENT_PENDULUM_H_
#define CORE_ENVIRONMENT_PENDULUM_H_

#include <vector>

#include "absl/strings/string_view.h"
#include "core/environment/classic_control.h"

namespace spikeserve {

// Physical constants; the defaults are Gymnasium's.
struct PendulumParameters {
  double gravity = 10.0;  // m/s^2
  double mass = 1.0;      // kg
  double length = 1.0;    // m
  double force = 1.0;     // torque on the pendulum per unit of the action
};

class Pendulum final : public ClassicControl {
 public:
  static constexpr absl::string_view kId = "Pendulum-v1";
  static constexpr double kMaxSpeed = 8.0;  // rad/s

  explicit Pendulum(const PendulumParameters& parameters = {});

  double Advance(const Action& action, absl::Span<double> state) const override;
  bool IsTerminal(absl::Span<const double> state) const override;

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override;
  std::vector<float> Observe(absl::Span<const double> state) const override;

  PendulumParameters parameters_;
};

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_PENDULUM_H_
