// Weights laid out for the streaming engine: one contiguous row per input, lanes are output
// neurons.
//
// Immutable once built; safe to share between threads.
#ifndef CORE_ENGINE_SPIKING_PACKED_WEIGHTS_H_
#define CORE_ENGINE_SPIKING_PACKED_WEIGHTS_H_

#include <cstdint>
#include <initializer_list>
#include <vector>

#include "core/engine/spiking/aligned_vector.h"
#include "core/model/policy.h"
#include "core/neuron/period_table.h"

namespace spikeserve {

// Outputs are padded with zero weights to a multiple of this, so that spikes fill whole 32-bit
// words. A padded neuron never fires: its current is zero and thresholds are positive.
inline constexpr int kLanes = 32;

constexpr int PadToLanes(int n) { return (n + kLanes - 1) / kLanes * kLanes; }

struct PackedLinear {
  int inputs = 0;
  int outputs = 0;                  // lanes up to the last one that is not padding
  int width = 0;                    // all lanes
  AlignedVector<float> rows;        // [inputs][width]
  AlignedVector<float> bias;        // [width]
  AlignedVector<uint32_t> nonzero;  // [inputs]: nonzero weights an input meets

  const float* row(int input) const { return rows.data() + static_cast<size_t>(input) * width; }
};

// Several linears of equal inputs side by side, each padded on its own.
PackedLinear Pack(std::initializer_list<const Linear*> linears);

struct PackedLayer {
  PackedLinear key_value_query;  // [in][3 pad(d)]; a token that leaves only keys and values uses
                                 // the first two thirds
  std::vector<uint32_t> nonzero_query;  // [in]: the query's share of key_value_query.nonzero
  PackedLinear routing_hidden;          // modes with routing
  PackedLinear routing_gate;
  // Nonzero products of routing_gate at a tick at which no head says anything.
  uint64_t silent_gate_products = 0;
  PackedLinear attention_output;
  PackedLinear ffn_hidden;
  PackedLinear ffn_output;
  std::vector<float>
      attention_weight;  // [H][d_h + 1]: exp(-|c_h| distance), distance from the best overlap
};

struct PackedWeights {
  explicit PackedWeights(const Policy& policy);

  PackedLinear embed_return;
  PackedLinear embed_state;
  PackedLinear embed_action;
  std::vector<PackedLayer> layers;
  std::vector<uint32_t> head_nonzero;  // [d]
  PeriodTable periods;                 // of the coders' neurons
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_PACKED_WEIGHTS_H_
