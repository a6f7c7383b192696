// Dendritic routing: gates over heads, and the gated heads (eq. 4.10 and 4.11).
//
// Every sum is per lane, or in the one order the reference fixes, so that each SIMD target gives
// the same bits. Pure functions on plain arrays; safe to call from many threads.
#ifndef CORE_ENGINE_SPIKING_KERNELS_ROUTING_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_ROUTING_KERNELS_H_

#include <cstddef>

#include "core/engine/spiking/packed_weights.h"

namespace spikeserve::kernels {

// The softmax of the first `size` entries of every row [stride], in place; `stride` is a multiple
// of kLanes, and the other entries of a row are overwritten.
void Softmax(float* rows, int count, int stride, int size);

// What the heads say about one token, at those ticks at which one of them says anything:
// [ticks][heads][head_size].
struct HeadOutputs {
  int ticks = 0;
  int all_ticks = 0;  // T
  int heads = 0;
  int head_size = 0;
  const float* y = nullptr;

  const float* at(int tick, int head) const {
    return y + (static_cast<size_t>(tick) * heads + head) * head_size;
  }
};

// merged = mean over all ticks of the heads times their gates [ticks][stride], summed [head_size]
// (eq. 4.11) or side by side [heads * head_size].
void GateHeads(const HeadOutputs& heads, const float* gates, int stride, bool concat,
               float* merged);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_ROUTING_KERNELS_H_
