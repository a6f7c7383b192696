// Runs the parts of integer arithmetic (docs/design/integer.md): coders as tables, LIF neurons that
// are updated by events, and fixed-point maps.
//
// Integer sums are exact, so every SIMD target gives equal results. All functions are thread-safe
// on distinct arrays.
#pragma once

#include <cstdint>

#include "core/engine/spiking/kernels/active_inputs.h"
#include "core/engine/spiking/kernels/drive.h"
#include "core/engine/spiking/packed/packed_fixed_point.h"
#include "core/engine/spiking/packed_integers.h"
#include "core/neuron/shift_lif.h"

namespace spikeserve::kernels {

// Sets periods[j] to the period of neuron j under x[j], or to 0 if it does not fire, for
// j < coder.width. Sets bit j % 32 of active[j / 32] if neuron j fires, and clears it otherwise.
// `x` is [coder.width], from -32767 to 32767.
void CoderPeriods(const PackedPeriodCoder& coder, const int16_t* x, int32_t* periods,
                  uint32_t* active);

// Returns `sum`, set to the sum of the rows of `members` [count] for lane < width. REQUIRES:
// count > 0.
const int16_t* SumRows(const PackedIntegerPopulation& population, const int32_t* members, int count,
                       int width, int16_t* sum);

// Runs the neurons of the lanes first ... first + width - 1 from V = 0 and writes their spikes to
// `bits` [ticks][width / 32]: lane first + i is bit i % 32 of word i / 32. A tick without a term in
// `drive` has no input spike. REQUIRES: `first` and `width` are multiples of kLanes.
void LifBits(const ShiftLif& lif, const PackedIntegerPopulation& population,
             const Drive<int16_t>& drive, int first, int width, uint32_t* bits);

// As LifBits, but sets counts[i] to the number of spikes of lane first + i. Returns the total.
uint64_t LifCounts(const ShiftLif& lif, const PackedIntegerPopulation& population,
                   const Drive<int16_t>& drive, int first, int width, int16_t* counts);

// Sets output[lane] to RoundShift(sum of the products) + bias for all lanes. `input` is
// [pad(map.inputs)], and 0 from map.inputs on. Returns the number of products of a nonzero input
// and a nonzero weight. `active` is memory for the call.
uint64_t Apply(const PackedFixedPointMap& map, const int16_t* input, ActiveInputs* active,
               int32_t* output);

}  // namespace spikeserve::kernels
