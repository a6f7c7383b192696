// Compares a step that a request repeats with the step that the session has taken. A request sent
// again has the same content; another content is that of a second robot with the same session id.
//
// Free functions without shared state; safe to call from many threads on distinct sessions.
#ifndef CORE_AGENT_REPEATED_STEP_H_
#define CORE_AGENT_REPEATED_STEP_H_

#include <cstdint>
#include <optional>

#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/action/reported_action.h"
#include "core/session/session.h"

namespace spikeserve {

// A step of the running episode. Views of a request.
struct RepeatedStep {
  int64_t step = 0;
  absl::Span<const float> observation;
  double reward = 0.0;                          // of the action before
  std::optional<ReportedAction> executed = {};  // at the step before; absent: not compared
};

// Returns OK if the step has the content that `session` has of it, and a conflict that names the
// field, its element and both values if not. Compares what the session has: the observation, the
// executed action, and the reward within the rounding of the return-to-go in float32. Steps that
// are older than the history of the session are not compared, nor are rewards and actions before
// its first timestep. Returns INVALID_ARGUMENT if `executed` is not an action of `space`.
// REQUIRES: repeated.step < session.step.
absl::Status CheckRepeatedStep(const RepeatedStep& repeated, const ActionSpace& space,
                               const Session& session);

// Returns whether `status` is a conflict: a FAILED_PRECONDITION that nothing heals but another
// session id. Removes the mark by which it is known.
bool TakeConflict(absl::Status* status);

}  // namespace spikeserve

#endif  // CORE_AGENT_REPEATED_STEP_H_
