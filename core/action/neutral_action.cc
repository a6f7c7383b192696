#include "core/action/neutral_action.h"

namespace spikeserve {

Action NeutralAction(const ActionSpace& space) {
  Action neutral;
  for (size_t i = 0; i < space.low.size(); ++i) {
    const bool admits_zero = space.low[i] <= 0.0f && space.high[i] >= 0.0f;
    neutral.continuous.push_back(admits_zero ? 0.0f : 0.5f * space.low[i] + 0.5f * space.high[i]);
  }
  return neutral;
}

}  // namespace spikeserve
