// The action that a robot takes when it has no other.
#pragma once

#include "core/action/action_space.h"

namespace spikeserve {

// Returns the action nearest to doing nothing: index 0, or in each element of a Box 0, if the
// bounds admit it, and otherwise their middle. Thread-safe.
Action NeutralAction(const ActionSpace& space);

}  // namespace spikeserve
