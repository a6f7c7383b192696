// Switches off parts of a trained policy, to measure how much each part contributes. Pure functions
// of plain values.
#pragma once

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "core/model/policy.h"

namespace spikeserve {

// Switches off one part of `policy`:
//   context    attention is limited to the current timestep (N = 1)
//   attention  all tokens in the window have the same weight: c_h = 0
//   phase      the weights of the phase spikes are 0
//   routing    all heads have the same, constant gate
//   return     the return token is constant: G always equals the policy's return_offset
// Returns INVALID_ARGUMENT for an unknown part, with the known ones, or for a part that a policy of
// this mode does not have.
absl::Status Ablate(absl::string_view part, Policy* policy);

}  // namespace spikeserve
