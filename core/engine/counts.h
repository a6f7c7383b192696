// Stores what a decision costs: spikes by stage, synaptic operations by kind, membrane updates, and
// the other operations that an energy model (energy.h) prices.
//
// Plain values. The counts of the decision at timestep t are those of its new tokens a_{t-1}, G_t
// and s_t (G_0 and s_0 at step 0), whenever these were computed, and of the phase spikes of
// timestep t. Not counted are additions of biases and residuals, the action head's softmax or tanh,
// and single exponentials, roots and divisions.
#pragma once

#include <array>
#include <cstdint>

#include "core/base/enum_names.h"

namespace spikeserve {

// The neuron populations that emit spikes.
enum class Stage { kCoder, kPhase, kQuery, kKey, kValue, kFfnIn, kFfnHidden, kReadout };
inline constexpr int kStages = 8;

constexpr std::array<EnumName<Stage>, kStages> EnumNames(Stage) {
  return {{{Stage::kCoder, "coder"},
           {Stage::kPhase, "phase"},
           {Stage::kQuery, "query"},
           {Stage::kKey, "key"},
           {Stage::kValue, "value"},
           {Stage::kFfnIn, "ffn_in"},
           {Stage::kFfnHidden, "ffn_hidden"},
           {Stage::kReadout, "readout"}}};
}

// Numbers of spikes and operations. The reference engine (with counting.h) is their definition.
struct Counts {
  std::array<uint64_t, kStages> spikes_by_stage = {};
  // Synaptic operations as NeuroBench counts them, without biases.
  uint64_t accumulates = 0;           // input spike x nonzero weight
  uint64_t multiply_accumulates = 0;  // nonzero analog input x nonzero weight
  // Nonzero products inside attention (q & k, and p * v), which NeuroBench's hooks do not count.
  uint64_t attention_products = 0;
  // Those of multiply_accumulates whose weight is an 8-bit integer.
  uint64_t integer_multiply_accumulates = 0;

  // LIF neurons times the ticks at which they were updated, by one multiplication and one addition:
  // every tick, but in integer arithmetic only ticks with an input spike. A coder of integer
  // arithmetic has no LIF neurons.
  uint64_t membrane_updates = 0;

  // The next six are counted in integer arithmetic only.
  // LIF neurons whose population has an input spike in the token: their membranes begin at 0.
  uint64_t driven_neurons = 0;
  // Ticks for which a membrane leaked and integrated its bias: from the second one, because the
  // first begins at the bias, to that of the last input spike.
  uint64_t membrane_leaks = 0;
  // Those of integer_multiply_accumulates whose activation has 16 bits instead of 8.
  uint64_t wide_multiply_accumulates = 0;
  uint64_t attention_scalings = 0;  // nonzero sums of values, divided by the sum of their weights
  // Bytes of weights that are read: the nonzero ones of a neuron or a phase generator that fires,
  // once a token for all its spikes, and each other map whole, once for all new tokens.
  uint64_t weight_bytes = 0;
  // Bytes of keys, values and running sums of values that are read or written: of a token that is
  // stored, T d key bits, its values (ValueBytes()), and for each nonzero one a 16-bit sum twice
  // read and written; of a row of a head that is computed, the keys and values of all its tokens;
  // of every other row, the head's running sums.
  uint64_t attention_bytes = 0;

  // Except in integer arithmetic, the following depend only on the sizes of the model and on the
  // number of tokens in the window.
  // Elements times a coder's gain, plus its bias; in integer arithmetic, elements whose period a
  // coder looked up.
  uint64_t coder_gains = 0;
  uint64_t layer_norm_elements = 0;  // elements that went through a LayerNorm
  uint64_t softmax_terms = 0;        // terms of the softmaxes over keys and over gates
  uint64_t gate_products = 0;        // routing gate x element of a head's output

  uint64_t& spikes(Stage stage) { return spikes_by_stage[static_cast<size_t>(stage)]; }
  uint64_t spikes(Stage stage) const { return spikes_by_stage[static_cast<size_t>(stage)]; }
  uint64_t total_spikes() const;
  // Returns accumulates plus multiply-accumulates. Attention products are reported separately.
  uint64_t synaptic_operations() const { return accumulates + multiply_accumulates; }

  Counts& operator+=(const Counts& other);
  friend bool operator==(const Counts&, const Counts&) = default;
};

}  // namespace spikeserve
