// Runs the parts of attention in integer arithmetic (docs/design/integer.md) for one head.
//
// Integer sums are exact, so every SIMD target gives equal results. All functions are thread-safe
// on distinct arrays. "pad" rounds up to a multiple of kLanes.
#ifndef CORE_ENGINE_SPIKING_KERNELS_INTEGER_ATTENTION_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_INTEGER_ATTENTION_KERNELS_H_

#include <cstddef>
#include <cstdint>
#include <vector>

namespace spikeserve::kernels {

// Sets overlaps[i] to the number of bits that are set both in `query` [words] and in the key of
// slot slots[i], which starts at keys[slots[i] * stride]. Returns the sum.
uint64_t Overlaps(const uint64_t* query, int words, const uint64_t* keys, size_t stride,
                  const std::vector<int>& slots, int32_t* overlaps);

// Replaces the overlaps [pad(tokens)] by the weights of shiftmax, and what is behind them by 0.
// Returns the sum. `scale` is the head's. REQUIRES: tokens > 0.
int32_t Shiftmax(int32_t scale, int tokens, int32_t* overlaps);

// The values of a token and their weight.
struct WeightedValues {
  const int16_t* values;  // [pad(size)]
  int32_t weight;
};

// Sets sums[k] to the weighted sum of values[k] over all tokens, for k < pad(size).
void WeighValues(const std::vector<WeightedValues>& tokens, int size, int32_t* sums);

// Sets y[k] to sums[k] / divisor with kGateFraction fraction bits, rounded as RoundDivide and
// limited to kLargestAttended, for k < size. `sums` are [pad(size)], and from 0 to `divisor` for k
// < size. Returns the number of these that are not 0. REQUIRES: 0 < divisor < 2^31.
int ScaleSums(const int32_t* sums, int size, int32_t divisor, int16_t* y);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_INTEGER_ATTENTION_KERNELS_H_
