// Parts of a trained policy switched off, to see what they were worth to it. Pure functions of
// plain values.
#ifndef TRAIN_EVALUATION_ABLATION_H_
#define TRAIN_EVALUATION_ABLATION_H_

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "core/model/policy.h"

namespace spikeserve {

// Switches off one part of `policy`:
//   context    attention reaches the present timestep alone (N = 1)
//   attention  all tokens in reach count the same: c_h = 0
//   phase      phase spikes reach no synapse
//   routing    all heads count the same: constant gates
//   return     the return token says nothing: G reads as the policy's return_offset
// INVALID_ARGUMENT names the parts there are, or says that a policy of this mode has no such part.
absl::Status Ablate(absl::string_view part, Policy* policy);

}  // namespace spikeserve

#endif  // TRAIN_EVALUATION_ABLATION_H_
