// Stores weights in the layout of the streaming engine: one contiguous row per input, in which each
// lane is an output neuron.
//
// Immutable once built, and thread-safe.
#ifndef CORE_ENGINE_SPIKING_PACKED_WEIGHTS_H_
#define CORE_ENGINE_SPIKING_PACKED_WEIGHTS_H_

#include <cstdint>
#include <initializer_list>
#include <vector>

#include "core/engine/spiking/aligned_vector.h"
#include "core/model/policy.h"
#include "core/neuron/period_table.h"

namespace spikeserve {

// Outputs are padded to a multiple of this number with zero weights, so that spikes fill whole
// 32-bit words. A padding neuron never fires, because its current is zero and thresholds are
// positive.
inline constexpr int kLanes = 32;

constexpr int PadToLanes(int n) { return (n + kLanes - 1) / kLanes * kLanes; }

// One or several affine maps in this layout.
struct PackedLinear {
  int inputs = 0;
  int outputs = 0;                  // number of lanes up to the last one that is not padding
  int width = 0;                    // number of all lanes
  AlignedVector<float> rows;        // [inputs][width]
  AlignedVector<float> bias;        // [width]
  AlignedVector<uint32_t> nonzero;  // [inputs]: number of nonzero weights of an input

  // Returns the weights of one input, [width].
  const float* row(int input) const { return rows.data() + static_cast<size_t>(input) * width; }
};

// Packs several affine maps of equal inputs side by side. Pads each of them separately.
PackedLinear Pack(std::initializer_list<const Linear*> linears);

// The packed weights of one layer.
struct PackedLayer {
  // [in][3 pad(d)]. A token that needs no query uses only the first two thirds.
  PackedLinear key_value_query;
  std::vector<uint32_t> nonzero_query;  // [in]: the query's part of key_value_query.nonzero
  PackedLinear routing_hidden;          // modes with routing
  PackedLinear routing_gate;            // modes with routing
  // Number of nonzero products of routing_gate at a tick at which the outputs of all heads are
  // zero.
  uint64_t silent_gate_products = 0;
  PackedLinear attention_output;
  PackedLinear ffn_hidden;
  PackedLinear ffn_output;
  // [H][d_h + 1]: exp(-|c_h| distance), where the distance is that of an overlap from the best one.
  std::vector<float> attention_weight;
};

// The packed weights of a policy, and the period table of its coders.
struct PackedWeights {
  explicit PackedWeights(const Policy& policy);

  PackedLinear embed_return;
  PackedLinear embed_state;
  PackedLinear embed_action;
  std::vector<PackedLayer> layers;
  std::vector<uint32_t> head_nonzero;  // [d]: number of nonzero weights of an input
  PeriodTable periods;                 // of the coder neurons
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_PACKED_WEIGHTS_H_
