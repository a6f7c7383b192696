// Converts a float32 policy to an integer policy by rounding its spike-driven maps.
//
//   absl::StatusOr<Policy> integer = Quantize(policy);
//
// All functions are pure and thread-safe.
#ifndef CORE_QUANTIZE_QUANTIZE_H_
#define CORE_QUANTIZE_QUANTIZE_H_

#include "absl/status/statusor.h"
#include "core/model/policy.h"

namespace spikeserve {

// Returns `policy` with Arithmetic::kInt8. Everything except the spike-driven maps stays as it is.
//
// Each output neuron k has its own scale, a float32 number: max over j of |w_kj| / 127, and for the
// populations at least threshold / 16384. Weights, biases and thresholds are divided by it and
// rounded to the nearest integer, ties to even; thresholds are at least 1. The bias of ffn.output
// stays float32, and its scale is 1 where all weights of a row are 0.
//
// INVALID_ARGUMENT if `policy` is not valid, is not float32, is of mode dense, or has a
// membrane_decay, a bias or weights that 16 bits cannot hold. The message names the tensor or
// field.
absl::StatusOr<Policy> Quantize(const Policy& policy);

}  // namespace spikeserve

#endif  // CORE_QUANTIZE_QUANTIZE_H_
