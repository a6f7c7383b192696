// Tests whether the observations of a session are wired as in the training data, by the policy's
// WiringModel.
//
//   const bool begins = CheckWiring(policy, session.step, session.history, observation,
//                                   &session.wiring);
//   if (begins) Log(WiringText(policy, *session.wiring.verdict));
//
// In the first 50 steps of an episode, and of every 1,000, a window opens if the wiring of the
// training data does not explain them. In it each hypothesis (two elements exchanged, another sign,
// degrees, a delay) collects evidence, from a few steps before on, while it explains the steps
// better than the wiring of the training data does, and better than a robot that stands still. One
// that the steps contradict is not computed any more.
//
// Free functions; safe to call from many threads on distinct states. The results have equal bits on
// every processor.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/base/enum_names.h"
#include "core/model/policy.h"
#include "core/session/history.h"
#include "core/session/wiring_state.h"

namespace spikeserve {

// What follows from a verdict.
enum class WiringResponse { kCount, kWarn, kSafe };

// Names in labels of sessions and on command lines.
constexpr std::array<EnumName<WiringResponse>, 3> EnumNames(WiringResponse) {
  return {{{WiringResponse::kCount, "count"},
           {WiringResponse::kWarn, "warn"},
           {WiringResponse::kSafe, "safe"}}};
}

// The label that holds the WiringResponse that a session asked for.
inline constexpr char kWiringLabel[] = "wiring";

// Takes the next `observation` [obs], of timestep `step`, in environment units. `history` has the
// timesteps before it, with the actions that were executed; empty: they are unknown. Sets the
// state's verdict to the cause that explains the last steps best, and withdraws it when the steps
// contradict it. Returns whether a verdict begins. REQUIRES: CheckWiringState() accepts the state.
bool CheckWiring(const Policy& policy, int64_t step, const History& history,
                 absl::Span<const float> observation, WiringState* state);

// Returns the verdict in words, with the names of the elements.
std::string WiringText(const Policy& policy, const WiringVerdict& verdict);

// Returns INVALID_ARGUMENT unless `state` belongs to a session of `policy`.
absl::Status CheckWiringState(const Policy& policy, const WiringState& state);

}  // namespace spikeserve
