#include "core/engine/token_costs.h"

#include <cstdint>

namespace spikeserve {

void AddTokenCosts(const ModelConfig& config, TokenKind kind, int keys, Counts* counts) {
  const auto size = [](int value) { return static_cast<uint64_t>(value); };
  const uint64_t d = size(config.hidden_size);
  const uint64_t ticks = size(config.ticks);
  const uint64_t heads = size(config.heads);
  const uint64_t layers = size(config.layers);
  const bool is_state = kind == TokenKind::kState;
  // The layers whose output is computed: in the last layer only the state token's is used.
  const uint64_t outputs = is_state ? layers : layers - 1;

  // Every layer codes its input, every output is coded again, and the readout codes the state.
  const uint64_t coded = (layers + outputs + (is_state ? 1 : 0)) * d;
  const uint64_t neurons = layers * 2 * d + outputs * (d + size(config.ffn_size));
  counts->coder_gains += coded;
  counts->membrane_updates += ticks * (neurons + coded);
  if (config.has_norms()) counts->layer_norm_elements += (1 + 2 * outputs) * d;
  counts->softmax_terms += outputs * ticks * heads * size(keys);
  if (!config.has_routing()) return;
  counts->gate_products += outputs * ticks * d;
  if (config.gate == Gate::kSoftmax) counts->softmax_terms += outputs * ticks * heads;
}

uint64_t SharedWeightBytes(const ModelConfig& config, TokenKind kind, int inputs, int actions) {
  const auto size = [](int value) { return static_cast<uint64_t>(value); };
  const uint64_t d = size(config.hidden_size);
  uint64_t bytes = size(inputs) * d;
  if (kind != TokenKind::kState) return bytes;
  uint64_t layer = d * size(config.merged_size());  // attention.output
  if (config.is_dense()) layer += d * (3 * d + 2 * size(config.ffn_size));
  if (config.has_routing()) layer += size(config.routing_hidden_size) * (d + size(config.heads));
  return bytes + size(config.layers) * layer + size(actions) * d * sizeof(float);
}

uint64_t SpikeBytes(int ticks, int neurons) {
  return (static_cast<uint64_t>(ticks) * static_cast<uint64_t>(neurons) + 7) / 8;
}

uint64_t ValueBytes(const ModelConfig& config, int ticks, int neurons) {
  return config.attention == AttentionTicks::kByTick ? SpikeBytes(ticks, neurons)
                                                     : static_cast<uint64_t>(neurons);
}

}  // namespace spikeserve
