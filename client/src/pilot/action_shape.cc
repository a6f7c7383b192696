#include "client/src/pilot/action_shape.h"

#include <algorithm>
#include <cmath>

namespace spikeserve::piloting {

ActionShape::ActionShape(const v1::ActionSpace& space)
    : n_(space.discrete().n()),
      low_(space.box().low().begin(), space.box().low().end()),
      high_(space.box().high().begin(), space.box().high().end()) {}

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

ActionView ViewOf(const v1::Action& action) {
  return {.discrete = action.discrete(), .continuous = action.continuous().values()};
}

void ToProto(const ActionView& action, const ActionShape& shape, v1::Action* message) {
  if (shape.is_box()) {
    message->mutable_continuous()->mutable_values()->Assign(action.continuous.begin(),
                                                            action.continuous.end());
  } else {
    message->set_discrete(action.discrete);
  }
}

}  // namespace spikeserve::piloting
