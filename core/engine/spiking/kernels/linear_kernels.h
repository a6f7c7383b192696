// Multiplies analog vectors by packed weights, and computes LayerNorm.
//
// Every sum is computed per lane, or in the order of the reference engine, so that every SIMD
// target gives equal bits. All functions are thread-safe on distinct arrays.
#pragma once

#include <cstdint>

#include "core/engine/spiking/kernels/active_inputs.h"
#include "core/engine/spiking/packed/packed_linear.h"

namespace spikeserve::kernels {

// Sets output[lane] to the bias plus the products with the nonzero inputs, in ascending order of
// the inputs, for lane < linear.width. Returns the number of products of a nonzero input and a
// nonzero weight. `active` is memory for the call.
uint64_t Affine(const PackedLinear& linear, const float* input, ActiveInputs* active,
                float* output);

// As Affine, for `ticks` inputs at once. `input` is [ticks][stride]; `output` is
// [ticks][linear.width], in which the lanes from linear.outputs on may stay unchanged.
uint64_t AffineTicks(const PackedLinear& linear, const float* input, int stride, int ticks,
                     ActiveInputs* active, float* output);

// Equals the LayerNorm of core/math bit for bit.
void LayerNorm(const float* weight, const float* bias, float* x, int size);

}  // namespace spikeserve::kernels
