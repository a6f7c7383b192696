// Stores the integer maps of a layer in the layout of the streaming engine: each lane is an output
// neuron, and rows start on cache lines.
//
// Immutable once built, and thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <initializer_list>

#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/engine/spiking/packed/constant_array.h"
#include "core/model/integer_weights.h"

namespace spikeserve {

// One or several populations of equal inputs side by side. Each is padded to a multiple of kLanes
// (packed_weights.h) with neurons that never fire.
struct PackedIntegerPopulation {
  int inputs = 0;
  int outputs = 0;             // number of lanes up to the last one that is not padding
  int width = 0;               // number of all lanes
  ConstantArray<int8_t> rows;  // [inputs][width]
  // [inputs - d][width]: the rows of the phase inputs, which are added one by one, as currents.
  AlignedVector<int16_t> phase_rows;
  AlignedVector<int16_t> bias;      // [width]
  AlignedVector<int16_t> silent;    // [width]: the largest membrane that does not fire
  AlignedVector<uint32_t> nonzero;  // [inputs]: number of nonzero weights of an input

  // Returns the weights of one input, [width].
  const int8_t* row(int input) const { return rows.data() + static_cast<size_t>(input) * width; }
  int8_t weight(int input, int lane) const { return row(input)[lane]; }
  // Returns the weights of a phase generator, [width].
  const int16_t* phase_row(int generator) const {
    return phase_rows.data() + static_cast<size_t>(generator) * width;
  }
};

// Packs populations of equal inputs side by side. Inputs from `hidden_size` on are phase inputs.
PackedIntegerPopulation Pack(std::initializer_list<const IntegerPopulation*> populations,
                             int hidden_size);

}  // namespace spikeserve
