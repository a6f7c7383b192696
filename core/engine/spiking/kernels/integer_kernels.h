// Runs integer LIF neurons over the ticks of one token, and maps their spike counts to updates.
//
// Integer sums are exact, so every SIMD target gives equal results. The kernels of lif_kernels.h
// and linear_kernels.h are the same in float32. All functions are thread-safe on distinct arrays.
#ifndef CORE_ENGINE_SPIKING_KERNELS_INTEGER_KERNELS_H_
#define CORE_ENGINE_SPIKING_KERNELS_INTEGER_KERNELS_H_

#include <cstdint>

#include "core/engine/spiking/kernels/active_inputs.h"
#include "core/engine/spiking/kernels/drive.h"
#include "core/engine/spiking/packed_integers.h"
#include "core/neuron/integer_lif.h"

namespace spikeserve::kernels {

// Returns `sum`, set to the sum of the rows of `members` [count] for lane < width. REQUIRES:
// count > 0.
const int16_t* SumRows(const PackedIntegerPopulation& population, const int32_t* members, int count,
                       int width, int16_t* sum);

// Runs the neurons of the lanes first ... first + width - 1 from V = 0 and writes their spikes to
// `bits` [ticks][width / 32]: lane first + i is bit i % 32 of word i / 32. REQUIRES: `first` and
// `width` are multiples of kLanes.
void LifBits(const IntegerLif& lif, const PackedIntegerPopulation& population,
             const Drive<int16_t>& drive, int first, int width, uint32_t* bits);

// As LifBits for all lanes, but sets counts[lane] to the number of spikes. Returns the total.
uint64_t LifActivity(const IntegerLif& lif, const PackedIntegerPopulation& population,
                     const Drive<int16_t>& drive, int16_t* counts);

// Sets update[lane] = factor * float(sum over j of counts[j] * weight) + bias for all lanes.
// `counts` is [pad(F)], and 0 from F on. Returns the number of products of a nonzero count and a
// nonzero weight. `active` is memory for the call.
uint64_t Affine(const PackedIntegerOutput& output, const int16_t* counts, ActiveInputs* active,
                float* update);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_INTEGER_KERNELS_H_
