// CartPole-v1: balance a pole on a cart by pushing the cart to the left (action 0) or right (1).
//
// A. G. Barto, R. S. Sutton, C. W. Anderson, "Neuronlike Adaptive Elements That Can Solve Difficult
// Learning Control Problems", IEEE Trans. SMC 13(5), 1983, in Gymnasium's form (R. V. Florian's
// equations, explicit Euler steps of 0.02 s).
// - State and observation [4]: cart position [m], cart velocity [m/s], pole angle from upright
//   [rad], angular velocity [rad/s].
// - Reward: 1 per step, including the last one.
// - Termination: the position exceeds 2.4 m or the angle 12 degrees. Time limit: 500 steps.
#ifndef CORE_ENVIRONMENT_CART_POLE_H_
#define CORE_ENVIRONMENT_CART_POLE_H_

#include <vector>

#include "absl/strings/string_view.h"
#include "core/environment/classic_control.h"

namespace spikeserve {

// Physical constants; the defaults are Gymnasium's.
struct CartPoleParameters {
  double gravity = 9.8;      // m/s^2
  double cart_mass = 1.0;    // kg
  double pole_mass = 0.1;    // kg
  double half_length = 0.5;  // m, from the hinge to the pole's centre of mass
  double force = 10.0;       // N, of one push
  double wind = 0.0;         // N, constant force on the cart, positive to the right
};

class CartPole final : public ClassicControl {
 public:
  static constexpr absl::string_view kId = "CartPole-v1";

  explicit CartPole(const CartPoleParameters& parameters = {});

  double Advance(const Action& action, absl::Span<double> state) const override;
  bool IsTerminal(absl::Span<const double> state) const override;

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override;
  std::vector<float> Observe(absl::Span<const double> state) const override;

  CartPoleParameters parameters_;
};

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_CART_POLE_H_
