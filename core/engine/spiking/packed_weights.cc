#include "core/engine/spiking/packed_weights.h"

#include <cmath>

#include "core/math/exp.h"

namespace spikeserve {
namespace {

// Returns exp(-|c_h| distance) for every head and distance, [H][d_h + 1].
std::vector<float> AttentionWeights(const ModelConfig& config, const Tensor& scale) {
  std::vector<float> weights;
  for (int head = 0; head < config.heads; ++head) {
    for (int distance = 0; distance <= config.head_size(); ++distance) {
      weights.push_back(Exp(-std::abs(scale.values[head]) * static_cast<float>(distance)));
    }
  }
  return weights;
}

}  // namespace

template <class Arithmetic>
PackedWeights<Arithmetic>::PackedWeights(const Policy& policy)
    : embed_return(Pack({&policy.weights.embed_return.linear})),
      embed_state(Pack({&policy.weights.embed_state.linear})),
      embed_action(Pack({&policy.weights.embed_action.linear})),
      head_nonzero(NonzeroByInput(policy.weights.head)),
      periods({policy.config.membrane_decay, policy.config.threshold}, policy.config.ticks) {
  const int d = policy.config.hidden_size;
  for (const LayerWeights& weights : policy.weights.layers) {
    const auto& maps = Arithmetic::MapsOf(weights);
    PackedLayer<Arithmetic> layer;
    layer.key_value_query = Arithmetic::PackPopulations({&maps.key, &maps.value, &maps.query}, d);
    layer.nonzero_query = NonzeroByInput(maps.query);
    if (policy.config.has_routing()) {
      layer.routing_hidden = Pack({&weights.routing_hidden});
      layer.routing_gate = Pack({&weights.routing_gate});
      for (int j = 0; j < layer.routing_gate.inputs; ++j) {
        if (layer.routing_hidden.bias[j] > 0.0f) {
          layer.silent_gate_products += layer.routing_gate.nonzero[j];
        }
      }
    }
    layer.attention_output = Pack({&weights.attention_output});
    layer.ffn_hidden = Arithmetic::PackPopulations({&maps.ffn_hidden}, d);
    layer.ffn_output = Arithmetic::PackOutput(maps.ffn_output, policy.config.ticks);
    layer.attention_weight = AttentionWeights(policy.config, weights.scale);
    layers.push_back(std::move(layer));
  }
}

template struct PackedWeights<Float32Arithmetic>;
template struct PackedWeights<Int8Arithmetic>;

}  // namespace spikeserve
