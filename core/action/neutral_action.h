// The action that a robot takes when it has no other.
#ifndef CORE_ACTION_NEUTRAL_ACTION_H_
#define CORE_ACTION_NEUTRAL_ACTION_H_

#include "core/action/action_space.h"

namespace spikeserve {

// Returns the action nearest to doing nothing: index 0, or in each element of a Box 0, if the
// bounds admit it, and otherwise their middle. Thread-safe.
Action NeutralAction(const ActionSpace& space);

}  // namespace spikeserve

#endif  // CORE_ACTION_NEUTRAL_ACTION_H_
