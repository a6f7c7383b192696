// Spiking attention over keys and values that are bits.
//
// Counts are integers until they meet their weight, so that each SIMD target gives the same bits.
// Pure functions on plain arrays; safe to call from many threads. Symbols: T ticks, H heads, d_h
// head size, W = ceil(d_h / 32) words of a head's bits at a tick, S slots.
#ifndef CORE_ENGINE_SPIKING_KERNELS_ATTENTION_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_ATTENTION_KERNELS_H_

#include <cstdint>

#include "core/engine/spiking/packed_weights.h"

namespace spikeserve::kernels {

// A window of keys and values as bits; the token in slot s is bit s % 32 of word s / 32 where slots
// are bits.
struct AttentionWindow {
  int ticks = 0;
  int heads = 0;
  int head_size = 0;                   // d_h
  int words = 0;                       // W
  int slots = 0;                       // S, a multiple of 32
  const uint32_t* keys = nullptr;      // [T][H][W][S]: bits are dimensions
  const uint32_t* values = nullptr;    // [T][H][S / 32][32 W]: bits are slots
  const uint32_t* occupied = nullptr;  // [T][H][S / 32]: the slots that have a value bit at all
  const uint32_t* valid = nullptr;     // [S / 32]: the slots the query may attend to, at least one
};

// What Attend found.
struct Attended {
  int ticks = 0;          // at which a valid slot has a value; at the others y would be zero
  uint64_t products = 0;  // the sum of popcount(q & k) over all ticks, heads and valid slots
};

// y [Attended::ticks][H][d_h], contiguous, ticks ascending, for a query [T][H][W]: the softmax over
// valid slots of c_h popcount(q & k), times v. `y` has room for T ticks. `weight` is [H][d_h + 1]:
// exp(-|c_h| distance); `scale` [H] is c_h, whose sign says whether the best overlap is the
// largest.
Attended Attend(const AttentionWindow& window, const uint32_t* query, const float* weight,
                const float* scale, float* y);

// Writes one token's value bits [T][H][W] into slot `slot` of `values` and `occupied` (layout as in
// AttentionWindow).
void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window, uint32_t* values,
                 uint32_t* occupied);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_ATTENTION_KERNELS_H_
