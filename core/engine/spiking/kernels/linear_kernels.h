// Products of analog vectors with packed weights, and LayerNorm.
//
// Every sum is per lane, or in the one order the reference fixes, so that each SIMD target gives
// the same bits. Pure functions on plain arrays; safe to call from many threads.
#ifndef CORE_ENGINE_SPIKING_KERNELS_LINEAR_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_LINEAR_KERNELS_H_

#include <cstdint>

#include "core/engine/spiking/packed_weights.h"

namespace spikeserve::kernels {

// output[lane] = bias + the products with nonzero inputs, inputs ascending; lane < linear.width.
// Returns the number of products of a nonzero input and a nonzero weight.
uint64_t Affine(const PackedLinear& linear, const float* input, float* output);

// Affine for `ticks` inputs at once: input [ticks][stride], output [ticks][linear.width], of which
// lanes from linear.outputs on may be left as they were.
uint64_t AffineTicks(const PackedLinear& linear, const float* input, int stride, int ticks,
                     float* output);

// The LayerNorm of core/math, same bits.
void LayerNorm(const float* weight, const float* bias, float* x, int size);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_LINEAR_KERNELS_H_
