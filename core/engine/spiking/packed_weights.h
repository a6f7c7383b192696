// Stores the weights of a policy in the layout of the streaming engine.
//
// Immutable once built, and thread-safe.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/model/policy.h"
#include "core/neuron/period_table.h"

namespace spikeserve {

// The outcome of a feed-forward block whose neurons receive no spike: only their biases act.
struct SilentFeedForward {
  uint64_t spikes = 0;          // of the hidden neurons
  uint64_t products = 0;        // of ffn_output
  AlignedVector<float> update;  // [pad(d)]: of ffn_output
};

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
  SilentFeedForward silent_ffn;
  // [H][d_h + 1]: exp(-|c_h| distance), where the distance is that of an overlap from the best one.
  std::vector<float> attention_weight;
};

// The packed weights of a policy, and the period table of its coders.
struct PackedWeights {
  explicit PackedWeights(const Policy& policy);

  // Moves the rows of all maps to memory that the processes of this user share. Errors: see
  // ShareBytes (shared_bytes.h).
  absl::Status ShareRows(const std::string& folder);

  // Frees those numbers of `weights`, from which these were packed, that are stored here: weights,
  // biases and thresholds of all maps but the action head. Shapes and all other tensors stay.
  void DropFrom(Weights* weights) const;
  // Writes the numbers back that DropFrom() has freed.
  void RestoreTo(Weights* weights) const;

  PackedLinear embed_return;
  PackedLinear embed_state;
  PackedLinear embed_action;
  std::vector<PackedLayer> layers;
  std::vector<uint32_t> head_nonzero;  // [d]: number of nonzero weights of an input
  PeriodTable periods;                 // of the coder neurons
};

}  // namespace spikeserve
