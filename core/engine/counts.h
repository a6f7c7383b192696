// What a decision spends: spikes by stage, synaptic operations by kind, and energy estimates.
//
// Plain values. A decision's counts are those of its new tokens a_{t-1}, G_t and s_t (G_0 and s_0
// at step 0), whenever they were computed, and of the phase spikes of timestep t. Nothing that is
// spent is left out.
#ifndef CORE_ENGINE_COUNTS_H_
#define CORE_ENGINE_COUNTS_H_

#include <array>
#include <cstdint>

#include "core/base/enum_names.h"

namespace spikeserve {

// The neuron populations a spike can come from.
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

struct Counts {
  std::array<uint64_t, kStages> spikes_by_stage = {};
  // Synaptic operations as NeuroBench counts them, biases left out.
  uint64_t accumulates = 0;           // binary input x nonzero weight
  uint64_t multiply_accumulates = 0;  // nonzero analog input x nonzero weight
  // Nonzero products inside attention (q & k, and p * v), which NeuroBench's hooks do not see.
  uint64_t attention_products = 0;

  uint64_t& spikes(Stage stage) { return spikes_by_stage[static_cast<size_t>(stage)]; }
  uint64_t spikes(Stage stage) const { return spikes_by_stage[static_cast<size_t>(stage)]; }
  uint64_t total_spikes() const;
  // Accumulates and multiply-accumulates; attention products stand beside, not inside.
  uint64_t synaptic_operations() const { return accumulates + multiply_accumulates; }

  Counts& operator+=(const Counts& other);
  friend bool operator==(const Counts&, const Counts&) = default;
};

// Estimates in joules. The models answer different questions and are never summed with one another.
// They leave out memory traffic.
struct Energy {
  double spike_5pj = 0.0;  // the paper's: 5 pJ a spike
  double horowitz_45nm =
      0.0;  // 0.9 pJ an accumulate (attention's too), 4.6 pJ a multiply-accumulate, 45 nm CMOS
};

// `dense` counts attention products as multiply-accumulates: both of their factors are analog
// there.
Energy EstimateEnergy(const Counts& counts, bool dense);

}  // namespace spikeserve

#endif  // CORE_ENGINE_COUNTS_H_
