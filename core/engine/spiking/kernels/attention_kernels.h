// Computes spiking attention over keys and values that are bits.
//
// Values are counted as integers before the counts are multiplied by weights, so that every SIMD
// target gives equal bits. Symbols: T ticks, H heads, d_h head size, W = ceil(d_h / 32) words of a
// head's bits at a tick, S slots.
//
// All functions are thread-safe on distinct arrays.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/engine/spiking/packed/packed_linear.h"

namespace spikeserve::kernels {

// The keys and values of a window of tokens as bits, in planes of one tick and head each. In all
// bit arrays over the slots, the token in slot s is bit s % 32 of word s / 32.
struct AttentionWindow {
  static constexpr int32_t kNoPlane = -1;  // the number of a plane whose bits are all 0
  static constexpr int kRowSlots = 512;    // HasKeyRows(): S is a multiple of it

  int ticks = 0;
  int heads = 0;
  int head_size = 0;                // d_h
  int words = 0;                    // W
  int slots = 0;                    // S, a multiple of 64
  const uint32_t* bits = nullptr;   // [planes][32 W S / 32]
  const int32_t* keys = nullptr;    // [T][H]: number of the plane of the keys
  const int32_t* values = nullptr;  // [T][H]: number of the plane of the values
  // Bit i: the plane number i of [T][H] exists.
  const uint64_t* has_keys = nullptr;
  const uint64_t* has_values = nullptr;
  const uint32_t* occupied = nullptr;  // [T][H][S / 32]: the slots with at least one value bit
  const uint32_t* valid = nullptr;     // [S / 32]: slots that the query may attend to, at least one

  // Returns whether the planes of the keys are [32 W][S / 32], with slots as bits, so that a query
  // reads only the rows of its own bits. Planes of a short ring are [W][S], with dimensions as
  // bits. Planes of values are always [S / 32][32 W], with slots as bits.
  bool HasKeyRows() const { return slots % kRowSlots == 0; }

  // Returns a plane, or null if all of its bits are 0.
  const uint32_t* plane(int32_t number) const {
    return number == kNoPlane ? nullptr : bits + static_cast<size_t>(number) * words * slots;
  }
};

// What the scores of a layer's heads depend on.
struct HeadScores {
  const float* scale = nullptr;   // [H]: c_h
  const float* weight = nullptr;  // [H][d_h + 1]: exp(-|c_h| distance from the best overlap)
};

// The values that Attend returns in addition to y.
struct Attended {
  int ticks = 0;          // number of ticks at which a valid slot has a value
  uint64_t products = 0;  // sum of popcount(q & k) over all ticks, heads and valid slots
};

// Computes softmax(c_h popcount(q & k)) v over the valid slots for a query [T][H][W]. Writes
// only the Attended::ticks ticks at which a valid slot has a value, because y is zero at the
// others: y is [Attended::ticks][H][d_h], contiguous, ticks ascending, in an array with room for T
// ticks. The best overlap is the largest one if c_h >= 0, and otherwise the smallest one.
Attended Attend(const AttentionWindow& window, const uint32_t* query, const HeadScores& scores,
                float* y);

// Sets bit i of `nonzero` [ceil(T H / 64)] if any of the W words number i of `bits` [T][H][W] is
// not 0, and clears it otherwise.
void FindNonzero(const uint32_t* bits, int ticks_and_heads, int words, uint64_t* nonzero);

// Writes one token's value bits [T][H][W] into slot `slot` of planes, and sets or
// clears the slot in `occupied` [T][H][S / 32]. Bit i of `changed` [ceil(T H / 64)] shows whether
// the bits number i of [T][H] are written. REQUIRES: where they are, there is a plane.
void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window,
                 const uint64_t* changed, const int32_t* numbers, uint32_t* planes,
                 uint32_t* occupied);

}  // namespace spikeserve::kernels
