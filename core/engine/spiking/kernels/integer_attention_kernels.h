// Runs the parts of attention in integer arithmetic (docs/design/integer.md) for one head.
//
// Integer sums are exact, so every SIMD target gives equal results. All functions are thread-safe
// on distinct arrays. "pad" rounds up to a multiple of kLanes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace spikeserve::kernels {

// Tokens are stored in slots. The kernels take slots in whole blocks of this number.
inline constexpr int kSlotBlock = 16;

// Returns the length of a row of pairs, see HeadSlots.
constexpr size_t PairWidth(int head_size) { return static_cast<size_t>(head_size + 7) / 8 * 8; }

// The keys and values of a head by slot.
struct HeadSlots {
  // The bits of a key are words of 32 neurons, by tick. [slots / kSlotBlock][words][kSlotBlock].
  const uint32_t* keys;
  int words;
  // Pairs of spike counts, that of the even slot in the low bits. [slots / 2][PairWidth], and
  // kLanes more pairs that mean nothing.
  const uint16_t* values;
  int head_size;
  const int16_t* nonzero;  // number of values that are not 0, [slots]
};

// The values of one slot.
struct SlotValues {
  int heads;
  int head_size;
  int slots;  // of each head
  int slot;
  uint16_t* pairs;   // [heads], see HeadSlots
  int16_t* nonzero;  // [heads], see HeadSlots
  int32_t* sums;     // of the values of all slots, [heads][head_size] and kLanes zeros
};

// Stores a token's spike counts, [heads][head_size] and kLanes more, and adds them to the sums.
// Returns the number of counts that are not 0.
int StoreValues(const int16_t* counts, const SlotValues& values);

// Subtracts the values from the sums.
void RemoveValues(const SlotValues& values);

// A word of a query, and its number.
struct QueryWord {
  int number;
  uint32_t bits;
};

// Sets overlaps[s] to the number of bits that are set both in the query and in the key of slot s if
// held[s] is -1, and to 0 if it is 0. Returns the sum. `query` has the words that are not 0.
uint64_t Overlaps(const std::vector<QueryWord>& query, const HeadSlots& head, const int32_t* held,
                  int slots, int32_t* overlaps);

// Sets `weights` [slots] to those of shiftmax, and to 0 where held[s] is 0. Returns the sum.
// `scale` is the head's. REQUIRES: a token is held.
int32_t Shiftmax(int32_t scale, const int32_t* overlaps, const int32_t* held, int slots,
                 int16_t* weights);

// Sets sums[k] to the weighted sum of value k over all slots, for k < head_size. `sums` is
// [pad(head_size)]. Returns the number of values that are not 0 in slots whose weight is not 0.
// REQUIRES: weights are from 0 to 32767.
uint64_t WeighValues(const int16_t* weights, const HeadSlots& head, int slots, int32_t* sums);

// Sets y[k] to sums[k] / divisor with kGateFraction fraction bits, rounded as RoundDivide and
// limited to kLargestAttended, for k < size. `sums` are [pad(size)], and from 0 to `divisor` for k
// < size. Returns the number of these that are not 0. REQUIRES: 0 < divisor < 2^31.
int ScaleSums(const int32_t* sums, int size, int32_t divisor, int16_t* y);

// Adds factor * y[k] to sums[k], for k < size.
void AddScaled(const int16_t* y, int size, int32_t factor, int32_t* sums);

}  // namespace spikeserve::kernels
