// Compares a step that a request repeats with the step that the session has taken. A request sent
// again has the same content; another content is that of a second robot with the same session id.
//
// Free functions without shared state; safe to call from many threads on distinct sessions.
#pragma once

#include "absl/status/status.h"
#include "core/agent/step.h"

namespace spikeserve {

// Returns OK if `step` has the content that its session has of it, and a conflict that names the
// field, its element and both values if not. Compares what the session has: the observation, the
// executed action, and the reward within the rounding of the return-to-go in float32. Steps that
// are older than the history of the session are not compared, nor are rewards and actions before
// its first timestep. Returns INVALID_ARGUMENT if `executed` is not an action of the policy.
// REQUIRES: the step has a place in the running episode, before the next one.
absl::Status CheckRepeatedStep(const Step& step);

// Returns whether `status` is a conflict: a FAILED_PRECONDITION that nothing heals but another
// session id. Removes the mark by which it is known.
bool TakeConflict(absl::Status* status);

}  // namespace spikeserve
