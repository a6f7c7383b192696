// The routing of section 4 and of the appendix: one layer, which sees how active each head is.
//
// Pure functions; safe to call from many threads.
#pragma once

#include "absl/status/status.h"
#include "core/model/policy.h"

namespace spikeserve {

// Sets the hidden layer of every routing so that its output k is the mean of the outputs of head k,
// which are spike counts and therefore pass the ReLU unchanged:
//
//   gates = W_r [a_1 ... a_H]^T + b_r,   a_h = mean of y_h
//
// Returns INVALID_ARGUMENT, for the flag --activity_router, unless the policy has routing whose
// hidden size is the number of heads.
absl::Status RouteByActivity(Policy* policy);

// What has to keep its values in training (TrainOptions::frozen).
inline constexpr char kActivityRouterTensors[] = "routing.hidden";

}  // namespace spikeserve
