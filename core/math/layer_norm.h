// Computes LayerNorm with one order of summation, so that every engine and SIMD width gives equal
// bits.
//
// All functions are thread-safe on distinct arrays.
#pragma once

#include <cstddef>

namespace spikeserve {

inline constexpr float kLayerNormEpsilon = 1e-5f;

// Number of interleaved partial sums, equal to the number of float32 lanes of an AVX-512 register.
inline constexpr int kSumLanes = 16;

// Returns the sum of values[0, size). Adds element i to partial sum i mod 16, in ascending order of
// i, and then folds the 16 partial sums in halves (lane i with lane i + 8, then + 4, + 2, + 1).
float OrderedSum(const float* values, size_t size);

// Replaces x[0, size) with (x - mean) / sqrt(variance + 1e-5) * weight + bias. Computes both
// moments with OrderedSum; the variance is the sum of the squared centred values divided by `size`.
void LayerNorm(const float* weight, const float* bias, float* x, size_t size);

}  // namespace spikeserve
