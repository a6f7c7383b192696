#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "core/environment/classic_tasks.h"

namespace spikeserve {
namespace {

using std::numbers::pi;

constexpr double kPendulumTimeStep = 0.05;  // s
constexpr float kMaxTorque = 2.0F;          // N m

// Returns the angle in [-pi, pi). Computes the modulo like Python, whose result has the sign of the
// divisor.
double Normalize(double angle) {
  double turn = std::fmod(angle + pi, 2 * pi);
  if (turn < 0) turn += 2 * pi;
  return turn - pi;
}

class Pendulum final : public ClassicControl {
 public:
  explicit Pendulum(const PendulumParameters& parameters)
      : ClassicControl({.id = kPendulumId,
                        .state_size = 2,
                        .observation_size = 3,
                        .action_space = ActionSpace::Box({-kMaxTorque}, {kMaxTorque}),
                        .max_episode_steps = 200}),
        parameters_(parameters) {}

  double Advance(const Action& action, absl::Span<double> state) const override {
    const auto& [g, m, l, force] = parameters_;
    double &theta = state[0], &velocity = state[1];
    const float torque = std::clamp(action.continuous[0], -kMaxTorque, kMaxTorque);

    const double angle = Normalize(theta);
    // NumPy squares the float32 torque with powf, which sometimes rounds differently from
    // torque * torque. The exponent is volatile so that the compiler cannot replace the call by a
    // product.
    const volatile float two = 2.0F;
    const float torque_cost = 0.001F * std::pow(torque, two);
    const double cost = angle * angle + 0.1 * (velocity * velocity) + torque_cost;

    const float torque_acceleration = static_cast<float>(3.0 * force / (m * (l * l))) * torque;
    velocity += (3 * g / (2 * l) * std::sin(theta) + torque_acceleration) * kPendulumTimeStep;
    velocity = std::clamp(velocity, -kPendulumMaxSpeed, kPendulumMaxSpeed);
    theta += velocity * kPendulumTimeStep;

    return -cost;
  }

  bool IsTerminal(absl::Span<const double>) const override { return false; }

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override {
    const double angle = random.Uniform(-pi, pi);
    const double velocity = random.Uniform(-1.0, 1.0);
    return {angle, velocity};
  }

  std::vector<float> Observe(absl::Span<const double> state) const override {
    const std::array<double, 3> observation = {std::cos(state[0]), std::sin(state[0]), state[1]};
    return {observation.begin(), observation.end()};
  }

  PendulumParameters parameters_;
};

}  // namespace

std::unique_ptr<ClassicControl> MakePendulum(const PendulumParameters& parameters) {
  return std::make_unique<Pendulum>(parameters);
}

}  // namespace spikeserve
