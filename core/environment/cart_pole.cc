#include <cmath>
#include <numbers>

#include "core/environment/classic_tasks.h"

namespace spikeserve {
namespace {

constexpr double kCartPoleTimeStep = 0.02;  // s
constexpr double kPositionLimit = 2.4;      // m
constexpr double kAngleLimit = 12 * 2 * std::numbers::pi / 360;

class CartPole final : public ClassicControl {
 public:
  explicit CartPole(const CartPoleParameters& parameters)
      : ClassicControl({.id = kCartPoleId,
                        .state_size = 4,
                        .observation_size = 4,
                        .action_space = ActionSpace::Discrete(2),
                        .max_episode_steps = 500}),
        parameters_(parameters) {}

  double Advance(const Action& action, absl::Span<double> state) const override {
    const auto& [gravity, cart_mass, pole_mass, half_length, push, wind] = parameters_;
    const double total_mass = pole_mass + cart_mass;
    const double pole_mass_length = pole_mass * half_length;
    const double force = (action.discrete == 1 ? push : -push) + wind;

    double &x = state[0], &x_dot = state[1], &theta = state[2], &theta_dot = state[3];
    const double cosine = std::cos(theta);
    const double sine = std::sin(theta);
    const double temp = (force + pole_mass_length * (theta_dot * theta_dot) * sine) / total_mass;
    const double theta_acceleration =
        (gravity * sine - cosine * temp) /
        (half_length * (4.0 / 3.0 - pole_mass * (cosine * cosine) / total_mass));
    const double x_acceleration =
        temp - pole_mass_length * theta_acceleration * cosine / total_mass;

    x += kCartPoleTimeStep * x_dot;
    x_dot += kCartPoleTimeStep * x_acceleration;
    theta += kCartPoleTimeStep * theta_dot;
    theta_dot += kCartPoleTimeStep * theta_acceleration;

    return 1.0;
  }

  bool IsTerminal(absl::Span<const double> state) const override {
    return std::abs(state[0]) > kPositionLimit || std::abs(state[2]) > kAngleLimit;
  }

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override {
    std::vector<double> state(4);
    for (double& value : state) value = random.Uniform(-0.05, 0.05);
    return state;
  }

  std::vector<float> Observe(absl::Span<const double> state) const override {
    return {state.begin(), state.end()};
  }

  CartPoleParameters parameters_;
};

}  // namespace

std::unique_ptr<ClassicControl> MakeCartPole(const CartPoleParameters& parameters) {
  return std::make_unique<CartPole>(parameters);
}

}  // namespace spikeserve
