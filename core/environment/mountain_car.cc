#include "core/environment/mountain_car.h"

#include <algorithm>
#include <cmath>

namespace spikeserve {
namespace {

constexpr double kMinPosition = -1.2;
constexpr double kMaxPosition = 0.6;
constexpr double kMaxSpeed = 0.07;
constexpr double kGoalPosition = 0.5;

}  // namespace

MountainCar::MountainCar(const MountainCarParameters& parameters)
    : ClassicControl({.id = kId,
                      .state_size = 2,
                      .observation_size = 2,
                      .action_space = ActionSpace::Discrete(3),
                      .max_episode_steps = 200}),
      parameters_(parameters) {}

std::vector<double> MountainCar::DrawInitialState(NumpyRandom& random) const {
  return {random.Uniform(-0.6, -0.4), 0.0};
}

double MountainCar::Advance(const Action& action, absl::Span<double> state) const {
  const auto& [force, gravity] = parameters_;
  double &position = state[0], &velocity = state[1];

  velocity += (action.discrete - 1) * force + std::cos(3 * position) * (-gravity);
  velocity = std::clamp(velocity, -kMaxSpeed, kMaxSpeed);
  position = std::clamp(position + velocity, kMinPosition, kMaxPosition);
  if (position == kMinPosition && velocity < 0) velocity = 0;

  return -1.0;
}

bool MountainCar::IsTerminal(absl::Span<const double> state) const {
  return state[0] >= kGoalPosition && state[1] >= 0;
}

std::vector<float> MountainCar::Observe(absl::Span<const double> state) const {
  return {state.begin(), state.end()};
}

}  // namespace spikeserve
