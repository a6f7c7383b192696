// Multiplies analog vectors by packed weights, and computes LayerNorm and dendritic routing: gates
// over the heads, and the gated heads (eq. 4.10 and 4.11).
//
// Every sum is computed per lane, or in the order of the reference engine, so that every SIMD
// target gives equal bits. All functions are thread-safe on distinct arrays.
#pragma once

#include <cstddef>
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

// Replaces the first `size` entries of each of `count` rows [stride] by their softmax. Overwrites
// the other entries of a row with unspecified values. REQUIRES: `stride` is a multiple of
// kRoutingLanes.
void Softmax(float* rows, int count, int stride, int size);

// The outputs of the heads for one token, at the ticks at which at least one of them can be
// nonzero: [ticks][heads][head_size].
struct HeadOutputs {
  int ticks = 0;      // number of these ticks
  int all_ticks = 0;  // T
  int heads = 0;
  int head_size = 0;
  const float* y = nullptr;

  // Returns the output of one head at one of these ticks, [head_size].
  const float* at(int tick, int head) const {
    return y + (static_cast<size_t>(tick) * heads + head) * head_size;
  }
};

// Sets `merged` to the mean over all T ticks of the head outputs times their gates [ticks][stride]:
// summed over the heads, [head_size] (eq. 4.11), or if `concat`, concatenated, [heads * head_size].
void GateHeads(const HeadOutputs& heads, const float* gates, int stride, bool concat,
               float* merged);

}  // namespace spikeserve::kernels
