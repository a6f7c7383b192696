// Computes dendritic routing: gates over the heads, and the gated heads (eq. 4.10 and 4.11).
//
// Every sum is computed per lane, or in the order of the reference engine, so that every SIMD
// target gives equal bits. All functions are thread-safe on distinct arrays.
#pragma once

#include <cstddef>

#include "core/engine/spiking/packed/packed_linear.h"

namespace spikeserve::kernels {

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
