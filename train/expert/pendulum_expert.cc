// Experts for Pendulum: one step of lookahead on a value table of the undiscounted return, solved
// on 1440 angles x 1281 velocities x 41 torques.
//
// The optimal swing-up has no margin: a policy that imitates it imperfectly needs one more swing.
// Two experts therefore plan for disturbances, on 720 x 641 x 21 points. `robust` assumes that -2,
// 0 or 2 N m is added to every torque, each with probability 1/3; `cautious` assumes -1 or 1 N m,
// each with probability 1/4, and no disturbance otherwise. A disturbed pendulum cannot be held
// still, so the returns of these two are discounted.
#include <algorithm>
#include <memory>
#include <numbers>
#include <string>
#include <utility>

#include "core/base/status_macros.h"
#include "core/environment/classic_tasks.h"
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

// Returns `count` choices of torque, evenly spaced over the bounds. Each is executed with one of
// `disturbances` (N m) added and clamped to the bounds.
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
  const std::string name = options.name.empty() ? "value_iteration" : options.name;
  const bool robust = name == "robust", cautious = name == "cautious";
  if (!robust && !cautious && name != "value_iteration") {
    return UnknownExpert(options, "value_iteration, robust or cautious");
  }
  Problem problem = {.model = MakePendulum(), .choices = {}};
  Axes<2> axes = {{{-pi, pi, 720, true}, {-8.0, 8.0, 641}}};
  if (robust) {
    problem.choices = Torques(21, {-2.0f, 0.0f, 2.0f});
    problem.discount = 0.99;
  } else if (cautious) {
    problem.choices = Torques(21, {-1.0f, 0.0f, 0.0f, 1.0f});
    problem.discount = 0.99;
  } else {
    problem.choices = Torques(41, {0.0f});
    axes = {{{-pi, pi, 1440, true}, {-8.0, 8.0, 1281}}};
  }
  ASSIGN_OR_RETURN(
      ValueTable<2> table,
      LoadOrSolve<2>(options, name == "value_iteration" ? "pendulum" : "pendulum_" + name, problem,
                     axes, {.tolerance = 1e-2}));
  return std::make_unique<LookaheadExpert<2>>(
      std::move(problem), std::make_shared<const ValueTable<2>>(std::move(table)), /*depth=*/1);
}

}  // namespace spikeserve
