// Stores the fixed-point maps, norms and coders of a policy in integer arithmetic in the layout of
// the streaming engine: each lane is an output neuron, and rows start on cache lines.
//
// Immutable once built, and thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/engine/spiking/packed/constant_array.h"
#include "core/model/fixed_point_weights.h"

namespace spikeserve {

// A FixedPointMap. The rows of two successive inputs are interleaved, so that one instruction
// multiplies both by their activations and adds the products.
struct PackedFixedPointMap {
  int inputs = 0;
  int width = 0;                    // number of all lanes
  ConstantArray<int8_t> rows;       // [pad(inputs) / 2][width][2]
  AlignedVector<int32_t> left;      // [width]: bits by which a sum is first shifted to the left
  AlignedVector<int32_t> rounding;  // [width]: what is then added to it
  AlignedVector<int32_t> right;     // [width]: bits by which it is then shifted to the right
  AlignedVector<int32_t> bias;      // [width]
  AlignedVector<int16_t> nonzero;   // [pad(inputs)]: number of nonzero weights of an input

  // Returns the interleaved weights of the inputs 2 pair and 2 pair + 1, [width][2].
  const int8_t* row(int pair) const { return rows.data() + static_cast<size_t>(pair) * width * 2; }
  int8_t weight(int input, int lane) const { return row(input / 2)[2 * lane + input % 2]; }
};

// A PeriodCoder. Lanes that are padding never fire.
struct PackedPeriodCoder {
  int neurons = 0;
  int ticks = 0;
  int width = 0;                     // number of all lanes
  AlignedVector<int16_t> sign;       // [width]
  AlignedVector<int16_t> threshold;  // [T][width]
};

// A FixedPointNorm, which may be empty. Lanes that are padding have weight and bias 0.
struct PackedNorm {
  int size = 0;
  int width = 0;  // number of all lanes
  int shift = 0;
  AlignedVector<int16_t> weight;  // [width]
  AlignedVector<int16_t> bias;    // [width]
};

PackedFixedPointMap Pack(const FixedPointMap& map);
PackedNorm Pack(const FixedPointNorm& norm);
PackedPeriodCoder Pack(const PeriodCoder& coder);

}  // namespace spikeserve
