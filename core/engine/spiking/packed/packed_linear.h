// Stores float32 maps in the layout of the streaming engine: one contiguous row per input, in which
// each lane is an output neuron.
//
// Immutable once built, and thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <vector>

#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/engine/spiking/packed/constant_array.h"
#include "core/math/tensor.h"

namespace spikeserve {

// Outputs are padded to a multiple of this number with zero weights, so that spikes fill whole
// 32-bit words. A padding neuron never fires, because its current is zero and thresholds are
// positive.
inline constexpr int kLanes = 32;

constexpr int PadToLanes(int n, int lanes = kLanes) { return (n + lanes - 1) / lanes * lanes; }

// Outputs of the routing maps, which only AffineTicks reads, are padded to a multiple of the
// longest vector.
inline constexpr int kRoutingLanes = 16;

// One or several affine maps in this layout.
struct PackedLinear {
  int inputs = 0;
  int outputs = 0;                  // number of lanes up to the last one that is not padding
  int width = 0;                    // number of all lanes
  ConstantArray<float> rows;        // [inputs][width]
  AlignedVector<float> bias;        // [width]
  AlignedVector<uint32_t> nonzero;  // [inputs]: number of nonzero weights of an input

  // Returns the weights of one input, [width].
  const float* row(int input) const { return rows.data() + static_cast<size_t>(input) * width; }
  float weight(int input, int lane) const { return row(input)[lane]; }
};

// Returns the number of nonzero weights of each input, [in].
std::vector<uint32_t> NonzeroByInput(const auto& map) {
  const int outputs = map.weight.shape[0];
  const int inputs = map.weight.shape[1];
  std::vector<uint32_t> nonzero(inputs, 0);
  for (int i = 0; i < outputs; ++i) {
    for (int j = 0; j < inputs; ++j) nonzero[j] += map.weight.at(i, j) != 0;
  }
  return nonzero;
}

// Packs several affine maps of equal inputs side by side. Pads each of them separately, to a
// multiple of `lanes`.
PackedLinear Pack(std::initializer_list<const Linear*> linears, int lanes = kLanes);

}  // namespace spikeserve
