// Computes coder periods, and runs LIF neurons over the ticks of one token.
//
// Every sum is computed per lane, in the order of the reference engine, so that every SIMD target
// gives equal bits. All functions are thread-safe on distinct arrays.
#ifndef CORE_ENGINE_SPIKING_KERNELS_LIF_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_LIF_KERNELS_H_

#include <cstdint>
#include <vector>

#include "core/engine/spiking/packed_weights.h"
#include "core/neuron/lif.h"

namespace spikeserve::kernels {

// The input currents of a population. At tick t (0 ... ticks-1), the current is the bias plus the
// vectors terms[offsets[t]] ... terms[offsets[t+1]-1], added in that order.
struct Drive {
  int ticks = 0;
  std::vector<const float*> terms;
  std::vector<int> offsets;  // [ticks + 1]
};

// Sets periods[j] = table.Period(x[j] * gain[j] + bias[j]) for j < size. Sets bit j % 32 of
// active[j / 32] if neuron j fires, and clears it otherwise.
void CoderPeriods(const PeriodTable& table, const float* x, const float* gain, const float* bias,
                  int size, int32_t* periods, uint32_t* active);

// Sets sum[lane] to the sum of the rows of `members` [count], added in that order, for
// lane < width. REQUIRES: count > 0.
void SumRows(const PackedLinear& linear, const int32_t* members, int count, int width, float* sum);

// Runs the LIF neurons of the lanes first ... first + width - 1 from V = 0 and writes their spikes
// to `bits` [ticks][width / 32]: lane first + i is bit i % 32 of word i / 32. REQUIRES: `first` and
// `width` are multiples of kLanes.
void LifBits(const Lif& lif, const float* bias, const Drive& drive, int first, int width,
             uint32_t* bits);

// As LifBits from lane 0 on, but sets rates[lane] to the spike count divided by `ticks`. Returns
// the total number of spikes.
uint64_t LifRates(const Lif& lif, const float* bias, const Drive& drive, int width, float* rates);

// Returns the number of bits set in words[0, count).
uint64_t CountBits(const uint32_t* words, int count);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_LIF_KERNELS_H_
