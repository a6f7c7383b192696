// Pendulum: the undiscounted return on 1440 angles x 1281 velocities x 41 torques, and one step of
// lookahead.
//
// `robust` expects every torque to be disturbed by -2, 0 or 2 N m (720 x 641 x 21): the optimal
// swing-up has no margin, and who imitates it imperfectly pays for one more swing. Nothing can be
// held still under a disturbance, so its return is discounted.
#include <algorithm>
#include <memory>
#include <numbers>
#include <utility>

#include "core/environment/pendulum.h"
#include "train/expert/experts.h"
#include "train/expert/lookahead_expert.h"
#include "train/expert/table_file.h"

namespace spikeserve {
namespace {

using std::numbers::pi;

constexpr float kMaxTorque = 2.0f;

Action Torque(float torque) {
  return {.discrete = 0, .continuous = {std::clamp(torque, -kMaxTorque, kMaxTorque)}};
}

// `count` torques evenly over the bounds, each executed with one of `disturbances` added.
std::vector<Choice> Torques(int count, const std::vector<float>& disturbances) {
  std::vector<Choice> choices;
  for (int i = 0; i < count; ++i) {
    const float torque =
        kMaxTorque * (2.0f * static_cast<float>(i) / static_cast<float>(count - 1) - 1.0f);
    Choice& choice = choices.emplace_back(Choice{Torque(torque), {}});
    for (const float disturbance : disturbances) {
      choice.executed.push_back(Torque(torque + disturbance));
    }
  }
  return choices;
}

}  // namespace

absl::StatusOr<std::unique_ptr<Expert>> MakePendulumExpert(const ExpertOptions& options) {
  const bool robust = options.name == "robust";
  if (!robust && !options.name.empty() && options.name != "value_iteration") {
    return UnknownExpert(options, "value_iteration or robust");
  }
  const int angles = robust ? 720 : 1440;
  const int velocities = robust ? 641 : 1281;
  Problem problem = {.model = std::make_shared<Pendulum>(),
                     .choices = robust ? Torques(21, {-2.0f, 0.0f, 2.0f}) : Torques(41, {0.0f}),
                     .discount = robust ? 0.99 : 1.0};
  absl::StatusOr<ValueTable<2>> table =
      LoadOrSolve<2>(options, robust ? "pendulum_robust" : "pendulum", problem,
                     {{{-pi, pi, angles, true}, {-8.0, 8.0, velocities}}}, {.tolerance = 1e-2});
  if (!table.ok()) return table.status();
  return std::make_unique<LookaheadExpert<2>>(
      std::move(problem), std::make_shared<const ValueTable<2>>(*std::move(table)), /*depth=*/1);
}

}  // namespace spikeserve
