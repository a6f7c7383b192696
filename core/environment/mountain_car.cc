#include <algorithm>
#include <cmath>

#include "core/environment/classic_tasks.h"

namespace spikeserve {
namespace {

constexpr double kMinPosition = -1.2;
constexpr double kMaxPosition = 0.6;
constexpr double kMaxSpeed = 0.07;
constexpr double kGoalPosition = 0.5;

class MountainCar final : public ClassicControl {
 public:
  explicit MountainCar(const MountainCarParameters& parameters)
      : ClassicControl({.id = kMountainCarId,
                        .state_size = 2,
                        .observation_size = 2,
                        .action_space = ActionSpace::Discrete(3),
                        .max_episode_steps = 200}),
        parameters_(parameters) {}

  double Advance(const Action& action, absl::Span<double> state) const override {
    const auto& [force, gravity] = parameters_;
    double &position = state[0], &velocity = state[1];

    velocity += (action.discrete - 1) * force + std::cos(3 * position) * (-gravity);
    velocity = std::clamp(velocity, -kMaxSpeed, kMaxSpeed);
    position = std::clamp(position + velocity, kMinPosition, kMaxPosition);
    if (position == kMinPosition && velocity < 0) velocity = 0;

    return -1.0;
  }

  bool IsTerminal(absl::Span<const double> state) const override {
    return state[0] >= kGoalPosition && state[1] >= 0;
  }

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override {
    return {random.Uniform(-0.6, -0.4), 0.0};
  }

  std::vector<float> Observe(absl::Span<const double> state) const override {
    return {state.begin(), state.end()};
  }

  MountainCarParameters parameters_;
};

}  // namespace

std::unique_ptr<ClassicControl> MakeMountainCar(const MountainCarParameters& parameters) {
  return std::make_unique<MountainCar>(parameters);
}

}  // namespace spikeserve
