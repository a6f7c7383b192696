// Computes spiking attention over keys and values that are bits.
//
// Values are counted as integers before the counts are multiplied by weights, so that every SIMD
// target gives equal bits. Symbols: T ticks, H heads, d_h head size, W = ceil(d_h / 32) words of a
// head's bits at a tick, S slots.
//
// All functions are thread-safe on distinct arrays.
#ifndef CORE_ENGINE_SPIKING_KERNELS_ATTENTION_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_ATTENTION_KERNELS_H_

#include <cstdint>

#include "core/engine/spiking/packed_linear.h"

namespace spikeserve::kernels {

// The keys and values of a window of tokens as bits. In arrays whose bits are slots, the token in
// slot s is bit s % 32 of word s / 32.
struct AttentionWindow {
  int ticks = 0;
  int heads = 0;
  int head_size = 0;                   // d_h
  int words = 0;                       // W
  int slots = 0;                       // S, a multiple of 32
  const uint32_t* keys = nullptr;      // [T][H][W][S]: bits are dimensions
  const uint32_t* values = nullptr;    // [T][H][S / 32][32 W]: bits are slots
  const uint32_t* occupied = nullptr;  // [T][H][S / 32]: the slots with at least one value bit
  const uint32_t* valid = nullptr;     // [S / 32]: slots that the query may attend to, at least one
};

// The values that Attend returns in addition to y.
struct Attended {
  int ticks = 0;          // number of ticks at which a valid slot has a value
  uint64_t products = 0;  // sum of popcount(q & k) over all ticks, heads and valid slots
};

// Computes softmax(c_h popcount(q & k)) v over the valid slots for a query [T][H][W]. Writes only
// the Attended::ticks ticks at which a valid slot has a value, because y is zero at the others: y
// is [Attended::ticks][H][d_h], contiguous, ticks ascending, in an array with room for T ticks.
// `weight` is [H][d_h + 1]: exp(-|c_h| distance). `scale` is c_h, [H]; the best overlap is the
// largest one if c_h >= 0, and otherwise the smallest one.
Attended Attend(const AttentionWindow& window, const uint32_t* query, const float* weight,
                const float* scale, float* y);

// Writes one token's value bits [T][H][W] into slot `slot` of `values` and `occupied`, which have
// the layout of AttentionWindow.
void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window, uint32_t* values,
                 uint32_t* occupied);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_ATTENTION_KERNELS_H_
