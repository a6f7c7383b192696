// Coder periods, and LIF neurons over the ticks of one token.
//
// Every sum is per lane, in the order the reference fixes, so that each SIMD target gives the same
// bits. Pure functions on plain arrays; safe to call from many threads.
#ifndef CORE_ENGINE_SPIKING_KERNELS_LIF_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_LIF_KERNELS_H_

#include <cstdint>
#include <vector>

#include "core/engine/spiking/packed_weights.h"
#include "core/neuron/lif.h"

namespace spikeserve::kernels {

// What flows into a population: at tick t (0 ... ticks-1) the current is the bias plus the vectors
// terms[offsets[t]] ... terms[offsets[t+1]-1], added in that order.
struct Drive {
  int ticks = 0;
  std::vector<const float*> terms;
  std::vector<int> offsets;  // [ticks + 1]
};

// periods[j] = table.Period(x[j] * gain[j] + bias[j]), j < size. Bit j % 32 of active[j / 32] says
// whether neuron j fires at all.
void CoderPeriods(const PeriodTable& table, const float* x, const float* gain, const float* bias,
                  int size, int32_t* periods, uint32_t* active);

// sum[lane] = the rows of `members`, added up in that order; lane < width. REQUIRES: count > 0.
void SumRows(const PackedLinear& linear, const int32_t* members, int count, int width, float* sum);

// Runs LIF neurons from zero, those of lanes first ... first + width - 1, both multiples of kLanes.
// bits: [ticks][width / 32], lane first + i is bit i % 32 of word i / 32.
void LifBits(const Lif& lif, const float* bias, const Drive& drive, int first, int width,
             uint32_t* bits);

// As LifBits from lane 0 on, but rates[lane] = spikes / ticks; returns the number of all spikes.
uint64_t LifRates(const Lif& lif, const float* bias, const Drive& drive, int width, float* rates);

// Bits set in words[0, count).
uint64_t CountBits(const uint32_t* words, int count);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_LIF_KERNELS_H_
