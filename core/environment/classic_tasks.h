// Gymnasium's classic-control tasks. Each Make function returns a task with the given physical
// constants, whose defaults are Gymnasium's.
#pragma once

#include <memory>

#include "absl/strings/string_view.h"
#include "core/environment/classic_control.h"

namespace spikeserve {

struct CartPoleParameters {
  double gravity = 9.8;      // m/s^2
  double cart_mass = 1.0;    // kg
  double pole_mass = 0.1;    // kg
  double half_length = 0.5;  // m, from the hinge to the pole's centre of mass
  double force = 10.0;       // N, of one push
  double wind = 0.0;         // N, constant force on the cart, positive to the right
};

// CartPole-v1: balance a pole on a cart by pushing the cart to the left (action 0) or right (1).
//
// A. G. Barto, R. S. Sutton, C. W. Anderson, "Neuronlike Adaptive Elements That Can Solve Difficult
// Learning Control Problems", IEEE Trans. SMC 13(5), 1983, in Gymnasium's form (R. V. Florian's
// equations, explicit Euler steps of 0.02 s).
// - State and observation [4]: cart position [m], cart velocity [m/s], pole angle from upright
//   [rad], angular velocity [rad/s].
// - Reward: 1 per step, including the last one.
// - Termination: the position exceeds 2.4 m or the angle 12 degrees. Time limit: 500 steps.
std::unique_ptr<ClassicControl> MakeCartPole(const CartPoleParameters& parameters = {});
inline constexpr absl::string_view kCartPoleId = "CartPole-v1";

// As the change of velocity per step.
struct MountainCarParameters {
  double force = 0.001;
  double gravity = 0.0025;
};

// MountainCar-v0: drive an underpowered car out of a valley by pushing it to the left (action 0),
// coasting (1) or pushing it to the right (2).
//
// A. W. Moore, "Efficient Memory-based Learning for Robot Control", PhD thesis, Cambridge, 1990, in
// Gymnasium's form.
// - State and observation [2]: position in [-1.2, 0.6], velocity in [-0.07, 0.07], in the task's
//   own units.
// - Reward: -1 per step.
// - Termination: the position is at least 0.5 and the velocity at least 0. Time limit: 200 steps.
std::unique_ptr<ClassicControl> MakeMountainCar(const MountainCarParameters& parameters = {});
inline constexpr absl::string_view kMountainCarId = "MountainCar-v0";

// With Gymnasium's names.
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
std::unique_ptr<ClassicControl> MakeAcrobot(const AcrobotParameters& parameters = {});
inline constexpr absl::string_view kAcrobotId = "Acrobot-v1";

struct PendulumParameters {
  double gravity = 10.0;  // m/s^2
  double mass = 1.0;      // kg
  double length = 1.0;    // m
  double force = 1.0;     // torque on the pendulum per unit of the action
};

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
std::unique_ptr<ClassicControl> MakePendulum(const PendulumParameters& parameters = {});
inline constexpr absl::string_view kPendulumId = "Pendulum-v1";
inline constexpr double kPendulumMaxSpeed = 8.0;  // rad/s

}  // namespace spikeserve
