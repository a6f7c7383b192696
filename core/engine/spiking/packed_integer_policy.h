// Stores the weights of a policy in integer arithmetic in the layout of the streaming engine.
//
// Immutable once built, and thread-safe.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/engine/spiking/packed/packed_fixed_point.h"
#include "core/engine/spiking/packed_integers.h"
#include "core/model/policy.h"
#include "core/neuron/phase.h"

namespace spikeserve {

struct PackedIntegerLayer {
  PackedPeriodCoder coder;
  // [in][3 pad(d)]: keys, values, queries. A token that needs no query uses the first two thirds.
  PackedIntegerPopulation key_value_query;
  std::vector<uint32_t> nonzero_key_value;  // [in]: their part of key_value_query.nonzero
  PackedFixedPointMap routing_hidden;       // modes with routing
  PackedFixedPointMap routing_gate;         // modes with routing
  PackedFixedPointMap attention_output;
  PackedNorm attention_norm;
  PackedPeriodCoder ffn_coder;
  PackedIntegerPopulation ffn_hidden;
  PackedFixedPointMap ffn_output;
  PackedNorm ffn_norm;
};

struct PackedEmbedding {
  PackedFixedPointMap linear;
  PackedNorm norm;
};

struct PackedIntegerPolicy {
  explicit PackedIntegerPolicy(const Policy& policy);

  // Moves the rows of all maps to memory that the processes of this user share. Errors: see
  // ShareBytes (shared_bytes.h).
  absl::Status ShareRows(const std::string& folder);

  // Frees the weights of the populations and of the maps behind them, which are stored here.
  void DropFrom(Weights* weights) const;
  // Writes the numbers back that DropFrom() has freed.
  void RestoreTo(Weights* weights) const;

  PackedEmbedding embed_return;
  PackedEmbedding embed_state;
  PackedEmbedding embed_action;
  std::vector<IntegerPhase> phases;  // [H]; empty in modes without phase spikes
  std::vector<PackedIntegerLayer> layers;
  PackedPeriodCoder readout_coder;
  std::vector<uint32_t> head_nonzero;  // [d]: number of nonzero weights of an input
};

}  // namespace spikeserve
