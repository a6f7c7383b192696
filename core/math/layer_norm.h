// LayerNorm with one order of summation for every engine and SIMD width.
#ifndef CORE_MATH_LAYER_NORM_H_
#define CORE_MATH_LAYER_NORM_H_

#include <cstddef>

namespace spikeserve {

inline constexpr float kLayerNormEpsilon = 1e-5f;

// Width of the interleaved partial sums: what one AVX-512 register holds.
inline constexpr int kSumLanes = 16;

// The sum of values[0, size): element i is added to partial sum i mod 16, in ascending order; the
// 16 partial sums are then folded in halves (lane i with lane i + 8, then + 4, + 2, + 1).
float OrderedSum(const float* values, size_t size);

// y = (x - mean) / sqrt(variance + 1e-5) * weight + bias over x[0, size), in place; both moments by
// OrderedSum, the variance of the centred values divided by `size`.
void LayerNorm(const float* weight, const float* bias, float* x, size_t size);

}  // namespace spikeserve

#endif  // CORE_MATH_LAYER_NORM_H_
