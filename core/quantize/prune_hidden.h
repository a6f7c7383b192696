// Leaves hidden neurons out of a policy in integer arithmetic.
//
// All functions are pure and thread-safe.
#pragma once

#include <vector>

#include "core/model/policy.h"

namespace spikeserve {

// Returns `policy` without the hidden neurons whose entry of `is_needed` [L][F] is false. While
// none of them would fire, the decisions of both policies are equal, bit for bit. All layers have
// the same number of hidden neurons: as many as the layer that needs most of them, at least 1. The
// other layers keep their first silent ones as well. REQUIRES: a valid policy with
// Arithmetic::kInteger and spikes.
Policy PruneHidden(const Policy& policy, const std::vector<std::vector<bool>>& is_needed);

}  // namespace spikeserve
