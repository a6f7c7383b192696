#include "core/engine/spiking/packed_weights.h"

#include <cmath>

#include "core/math/exp.h"

namespace spikeserve {
namespace {

// Returns the number of nonzero weights of each input, [in].
std::vector<uint32_t> NonzeroByInput(const Linear& linear) {
  const int outputs = linear.weight.shape[0];
  const int inputs = linear.weight.shape[1];
  std::vector<uint32_t> nonzero(inputs, 0);
  for (int i = 0; i < outputs; ++i) {
    for (int j = 0; j < inputs; ++j) nonzero[j] += linear.weight.at(i, j) != 0.0f;
  }
  return nonzero;
}

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

PackedLinear Pack(std::initializer_list<const Linear*> linears) {
  PackedLinear packed;
  packed.inputs = (*linears.begin())->weight.shape[1];
  for (const Linear* linear : linears) packed.width += PadToLanes(linear->weight.shape[0]);
  packed.rows.assign(static_cast<size_t>(packed.inputs) * packed.width, 0.0f);
  packed.bias.assign(packed.width, 0.0f);
  packed.nonzero.assign(packed.inputs, 0);
  int lane = 0;
  for (const Linear* linear : linears) {
    const int outputs = linear->weight.shape[0];
    for (int i = 0; i < outputs; ++i) {
      packed.bias[lane + i] = linear->bias.values[i];
      for (int j = 0; j < packed.inputs; ++j) {
        packed.rows[static_cast<size_t>(j) * packed.width + lane + i] = linear->weight.at(i, j);
      }
    }
    const std::vector<uint32_t> nonzero = NonzeroByInput(*linear);
    for (int j = 0; j < packed.inputs; ++j) packed.nonzero[j] += nonzero[j];
    packed.outputs = lane + outputs;
    lane += PadToLanes(outputs);
  }
  return packed;
}

PackedWeights::PackedWeights(const Policy& policy)
    : embed_return(Pack({&policy.weights.embed_return.linear})),
      embed_state(Pack({&policy.weights.embed_state.linear})),
      embed_action(Pack({&policy.weights.embed_action.linear})),
      head_nonzero(NonzeroByInput(policy.weights.head)),
      periods({policy.config.membrane_decay, policy.config.threshold}, policy.config.ticks) {
  for (const LayerWeights& weights : policy.weights.layers) {
    PackedLayer layer;
    layer.key_value_query = Pack({&weights.key, &weights.value, &weights.query});
    layer.nonzero_query = NonzeroByInput(weights.query);
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
    layer.ffn_hidden = Pack({&weights.ffn_hidden});
    layer.ffn_output = Pack({&weights.ffn_output});
    layer.attention_weight = AttentionWeights(policy.config, weights.scale);
    layers.push_back(std::move(layer));
  }
}

}  // namespace spikeserve
