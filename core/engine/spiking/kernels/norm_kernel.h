// Adds to the integer residual stream of a token, with a norm or without (docs/design/integer.md).
//
// Integer sums are exact, so every SIMD target gives equal results. Thread-safe on distinct arrays.
#pragma once

#include <cstdint>

#include "core/engine/spiking/packed/packed_fixed_point.h"

namespace spikeserve::kernels {

// x <- norm(x + sums). `x` and `sums` are [norm.width], and 0 from norm.size on; `x` is so after
// the call, too. Overwrites `sums`.
void Normalize(const PackedNorm& norm, int32_t* sums, int16_t* x);

// x <- sat(x + sums), both [width], a multiple of kLanes.
void AddLimited(int width, const int32_t* sums, int16_t* x);

}  // namespace spikeserve::kernels
