#include "core/engine/counts.h"

#include <numeric>

namespace spikeserve {
uint64_t Counts::total_spikes() const {
  return std::accumulate(spikes_by_stage.begin(), spikes_by_stage.end(), uint64_t{0});
}

Counts& Counts::operator+=(const Counts& other) {
  for (int i = 0; i < kStages; ++i) spikes_by_stage[i] += other.spikes_by_stage[i];
  accumulates += other.accumulates;
  multiply_accumulates += other.multiply_accumulates;
  attention_products += other.attention_products;
  integer_multiply_accumulates += other.integer_multiply_accumulates;
  wide_multiply_accumulates += other.wide_multiply_accumulates;
  driven_neurons += other.driven_neurons;
  membrane_leaks += other.membrane_leaks;
  attention_scalings += other.attention_scalings;
  weight_bytes += other.weight_bytes;
  attention_bytes += other.attention_bytes;
  membrane_updates += other.membrane_updates;
  coder_gains += other.coder_gains;
  layer_norm_elements += other.layer_norm_elements;
  softmax_terms += other.softmax_terms;
  gate_products += other.gate_products;
  return *this;
}

}  // namespace spikeserve
