// CartPole-v1: keep a pole upright on a cart that is pushed left (0) or right (1).
//
// A. G. Barto, R. S. Sutton, C. W. Anderson, "Neuronlike Adaptive Elements That Can Solve Difficult
// Learning Control Problems", IEEE Trans. SMC 13(5), 1983, in Gymnasium's form (R. V. Florian's
// equations, explicit Euler of 0.02 s).
// - State and observation [4]: position [m], velocity [m/s], pole angle from upright [rad], angular
//   velocity [rad/s].
// - Reward: 1 a step, the last one included.
// - End: beyond 2.4 m or 12 degrees; limit 500 steps.
#ifndef CORE_ENVIRONMENT_CART_POLE_H_
#define CORE_ENVIRONMENT_CART_POLE_H_

#include <vector>

#include "absl/strings/string_view.h"
#include "core/environment/classic_control.h"

namespace spikeserve {

// Gymnasium's physical constants.
struct CartPoleParameters {
  double gravity = 9.8;      // m/s^2
  double cart_mass = 1.0;    // kg
  double pole_mass = 0.1;    // kg
  double half_length = 0.5;  // m, from the hinge to the pole's centre of mass
  double force = 10.0;       // N, of a push
  double wind = 0.0;         // N, on the cart at every step, to the right
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
