// Computes coder periods, and runs LIF neurons over the ticks of one token.
//
// Every sum is computed per lane, in the order of the reference engine, so that every SIMD target
// gives equal bits. All functions are thread-safe on distinct arrays.
#pragma once

#include <cstdint>

#include "core/engine/spiking/kernels/drive.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/neuron/lif.h"
#include "core/neuron/period_table.h"

namespace spikeserve::kernels {

// Sets periods[j] = table.Period(x[j] * gain[j] + bias[j]) for j < size. Sets bit j % 32 of
// active[j / 32] if neuron j fires, and clears it otherwise.
void CoderPeriods(const PeriodTable& table, const float* x, const float* gain, const float* bias,
                  int size, int32_t* periods, uint32_t* active);

// Returns the sum of the rows of `members` [count], added in that order, for lane < width: the row
// itself if there is one member, and otherwise `sum`, where it writes the result. REQUIRES:
// count > 0.
const float* SumRows(const PackedLinear& linear, const int32_t* members, int count, int width,
                     float* sum);

// Runs the LIF neurons of the lanes first ... first + width - 1 of `linear` from V = 0 and writes
// their spikes to `bits` [ticks][width / 32]: lane first + i is bit i % 32 of word i / 32.
// REQUIRES: `first` and `width` are multiples of kLanes.
void LifBits(const Lif& lif, const PackedLinear& linear, const Drive<float>& drive, int first,
             int width, uint32_t* bits);

// As LifBits for all lanes, but sets rates[lane] to the spike count divided by `ticks`. Returns the
// total number of spikes.
uint64_t LifActivity(const Lif& lif, const PackedLinear& linear, const Drive<float>& drive,
                     float* rates);

// Returns the number of bits set in words[0, count).
uint64_t CountBits(const uint32_t* words, int count);

}  // namespace spikeserve::kernels
