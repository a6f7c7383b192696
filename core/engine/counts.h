// Stores what a decision costs: spikes by stage, synaptic operations by kind, and energy estimates.
//
// Plain values. The counts of the decision at timestep t are those of its new tokens a_{t-1}, G_t
// and s_t (G_0 and s_0 at step 0), whenever these were computed, and of the phase spikes of
// timestep t. They are complete: no spike or operation is left out.
#ifndef CORE_ENGINE_COUNTS_H_
#define CORE_ENGINE_COUNTS_H_

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

// Numbers of spikes and operations; see counting.h for their definition.
struct Counts {
  std::array<uint64_t, kStages> spikes_by_stage = {};
  // Synaptic operations as NeuroBench counts them, without biases.
  uint64_t accumulates = 0;           // input spike x nonzero weight
  uint64_t multiply_accumulates = 0;  // nonzero analog input x nonzero weight
  // Nonzero products inside attention (q & k, and p * v), which NeuroBench's hooks do not count.
  uint64_t attention_products = 0;

  uint64_t& spikes(Stage stage) { return spikes_by_stage[static_cast<size_t>(stage)]; }
  uint64_t spikes(Stage stage) const { return spikes_by_stage[static_cast<size_t>(stage)]; }
  uint64_t total_spikes() const;
  // Returns accumulates plus multiply-accumulates. Attention products are reported separately.
  uint64_t synaptic_operations() const { return accumulates + multiply_accumulates; }

  Counts& operator+=(const Counts& other);
  friend bool operator==(const Counts&, const Counts&) = default;
};

// Estimates in joules, without memory traffic. The two models answer different questions, so never
// add them up.
struct Energy {
  double spike_5pj = 0.0;  // the paper's model: 5 pJ per spike
  // 45 nm CMOS: 0.9 pJ per accumulate, including those of attention, and 4.6 pJ per
  // multiply-accumulate.
  double horowitz_45nm = 0.0;
};

// Estimates the energy of `counts`. If `dense`, attention products are counted as
// multiply-accumulates, because both of their factors are analog.
Energy EstimateEnergy(const Counts& counts, bool dense);

}  // namespace spikeserve

#endif  // CORE_ENGINE_COUNTS_H_
