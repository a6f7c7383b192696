#include "core/robot/action_shape.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace spikeserve::robot {

ActionShape::ActionShape(int64_t n, std::vector<float> low, std::vector<float> high)
    : n_(n), low_(std::move(low)), high_(std::move(high)) {}

bool ActionShape::Fit(const ActionView& action, ActionValue* fitted) const {
  if (!is_box()) {
    if (action.discrete < 0 || action.discrete >= n_) return false;
    fitted->discrete = action.discrete;
    return true;
  }
  const auto is_finite = [](float value) { return std::isfinite(value); };
  if (action.continuous.size() != size()) return false;
  if (!std::all_of(action.continuous.begin(), action.continuous.end(), is_finite)) return false;
  fitted->continuous.resize(size());
  for (size_t i = 0; i < size(); ++i) {
    fitted->continuous[i] = std::clamp(action.continuous[i], low_[i], high_[i]);
  }
  return true;
}

}  // namespace spikeserve::robot
