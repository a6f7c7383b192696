// Converts a dense policy to integer arithmetic, see quantize_integer.h.
#pragma once

#include "absl/status/status.h"
#include "core/model/policy.h"

namespace spikeserve {

// Sets the integers of `integer`, whose config says what they stand for, to those of `policy`, and
// clears the float32 numbers that they replace. INVALID_ARGUMENT, which names the tensor, if a
// number is too large. Pure and thread-safe.
absl::Status RoundDensePolicy(const Policy& policy, Policy* integer);

}  // namespace spikeserve
