#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "core/environment/classic_tasks.h"

namespace spikeserve {
namespace {

using std::cos;
using std::sin;
using std::numbers::pi;

constexpr double kAcrobotTimeStep = 0.2;  // s
constexpr double kMaxVelocity1 = 4 * pi;
constexpr double kMaxVelocity2 = 9 * pi;

using State = std::array<double, 4>;

// Returns the time derivative of `s` under `torque`.
State Derivative(const AcrobotParameters& parameters, double torque, const State& s) {
  const auto& [m1, m2, l1, lc1, lc2, i1, i2, g, full_torque] = parameters;
  const auto& [theta1, theta2, dtheta1, dtheta2] = s;
  const double d1 =
      m1 * (lc1 * lc1) + m2 * (l1 * l1 + lc2 * lc2 + 2 * l1 * lc2 * cos(theta2)) + i1 + i2;
  const double d2 = m2 * (lc2 * lc2 + l1 * lc2 * cos(theta2)) + i2;
  const double phi2 = m2 * lc2 * g * cos(theta1 + theta2 - pi / 2);
  const double phi1 = -m2 * l1 * lc2 * (dtheta2 * dtheta2) * sin(theta2) -
                      2 * m2 * l1 * lc2 * dtheta2 * dtheta1 * sin(theta2) +
                      (m1 * lc1 + m2 * l1) * g * cos(theta1 - pi / 2) + phi2;
  const double ddtheta2 =
      (torque + d2 / d1 * phi1 - m2 * l1 * lc2 * (dtheta1 * dtheta1) * sin(theta2) - phi2) /
      (m2 * (lc2 * lc2) + i2 - d2 * d2 / d1);
  const double ddtheta1 = -(d2 * ddtheta2 + phi1) / d1;
  return {dtheta1, dtheta2, ddtheta1, ddtheta2};
}

// Returns y + step * k.
State AddScaled(const State& y, double step, const State& k) {
  State result;
  for (int i = 0; i < 4; ++i) result[i] = y[i] + step * k[i];
  return result;
}

// Returns the state after one step of the classical fourth-order Runge-Kutta method from `y`.
State RungeKutta4(const AcrobotParameters& parameters, double torque, const State& y) {
  const State k1 = Derivative(parameters, torque, y);
  const State k2 = Derivative(parameters, torque, AddScaled(y, kAcrobotTimeStep / 2, k1));
  const State k3 = Derivative(parameters, torque, AddScaled(y, kAcrobotTimeStep / 2, k2));
  const State k4 = Derivative(parameters, torque, AddScaled(y, kAcrobotTimeStep, k3));
  State slope;
  for (int i = 0; i < 4; ++i) slope[i] = k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i];
  return AddScaled(y, kAcrobotTimeStep / 6, slope);
}

// Returns the angle in [-pi, pi].
double Wrap(double angle) {
  // Gymnasium subtracts turn by turn, which does not end for the angles of extreme perturbations.
  constexpr double kManyTurns = 1e4;
  if (!(std::abs(angle) < kManyTurns)) return std::remainder(angle, 2 * pi);
  while (angle > pi) angle -= 2 * pi;
  while (angle < -pi) angle += 2 * pi;
  return angle;
}

class Acrobot final : public ClassicControl {
 public:
  explicit Acrobot(const AcrobotParameters& parameters)
      : ClassicControl({.id = kAcrobotId,
                        .state_size = 4,
                        .observation_size = 6,
                        .action_space = ActionSpace::Discrete(3),
                        .max_episode_steps = 500}),
        parameters_(parameters) {}

  double Advance(const Action& action, absl::Span<double> state) const override {
    const double torque = (action.discrete - 1) * parameters_.torque;
    const State next = RungeKutta4(parameters_, torque, {state[0], state[1], state[2], state[3]});
    state[0] = Wrap(next[0]);
    state[1] = Wrap(next[1]);
    state[2] = std::clamp(next[2], -kMaxVelocity1, kMaxVelocity1);
    state[3] = std::clamp(next[3], -kMaxVelocity2, kMaxVelocity2);

    return IsTerminal(state) ? 0.0 : -1.0;
  }

  bool IsTerminal(absl::Span<const double> state) const override {
    return -cos(state[0]) - cos(state[1] + state[0]) > 1.0;
  }

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override {
    std::vector<double> state(4);
    // Gymnasium rounds only this state to float32.
    for (double& value : state) value = static_cast<float>(random.Uniform(-0.1, 0.1));
    return state;
  }

  std::vector<float> Observe(absl::Span<const double> state) const override {
    const std::array<double, 6> observation = {cos(state[0]), sin(state[0]), cos(state[1]),
                                               sin(state[1]), state[2],      state[3]};
    return {observation.begin(), observation.end()};
  }

  AcrobotParameters parameters_;
};

}  // namespace

std::unique_ptr<ClassicControl> MakeAcrobot(const AcrobotParameters& parameters) {
  return std::make_unique<Acrobot>(parameters);
}

}  // namespace spikeserve
