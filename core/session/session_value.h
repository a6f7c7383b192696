// What decisions do to the value of a session, and the checks of the numbers that they come with.
//
// Free functions without shared state; safe to call from many threads on distinct sessions.
#pragma once

#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/session/session.h"

namespace spikeserve {

// Returns the value of a new session at step 0 of its first episode.
Session NewSession(std::string id, SessionOptions options);

// Returns G_{t+1} = G_t - r_t, which conditions the next decision of `session`, in double precision
// so that rounding errors do not accumulate over an episode.
double NextReturnToGo(const Session& session, double reward);

// Puts `executed` in the place of the last answered action of `session`: in the history and in what
// the session learns from. Returns the outcome of the update of the head that replaces the
// decision's update, if there is one. REQUIRES: the running episode has a decision.
std::optional<UpdateOutcome> ReplaceLastAction(const Policy& policy, const Action& executed,
                                               Session* session);

// Adds an answered decision to `session`: its history, its counters and its last answer. `reward`
// is 0 at step 0.
void CountDecision(const Policy& policy, Answer answer, absl::Span<const float> observation,
                   double reward, Session* session);

// Counts a step of which only the `reward` of the action before is known. Its timestep is missing
// in the history, which must be cleared before the next one is added.
void CountSkipped(double reward, Session* session);

// Returns INVALID_ARGUMENT unless `target_return` is finite as a float32, the type that the model
// reads.
absl::Status CheckTargetReturn(double target_return);

// Returns INVALID_ARGUMENT unless `observation` has `expected_size` finite numbers.
absl::Status CheckObservation(absl::Span<const float> observation, int expected_size);

// Returns INVALID_ARGUMENT unless `reward` is finite and `next_return_to_go`, which follows from
// it, is finite as a float32.
absl::Status CheckReward(double reward, double next_return_to_go);

}  // namespace spikeserve
