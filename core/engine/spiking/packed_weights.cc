#include "core/engine/spiking/packed_weights.h"

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "core/engine/spiking/kernels/drive.h"
#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/kernels/linear_kernels.h"
#include "core/engine/spiking/kernels/targets.h"
#include "core/engine/spiking/packed/packed_rows.h"
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

SilentFeedForward RunSilently(const ModelConfig& config, const PackedLayer& layer) {
  kernels::Drive<float> drive;
  drive.ticks = config.ticks;
  drive.offsets.assign(static_cast<size_t>(config.ticks) + 1, 0);
  AlignedVector<float> hidden(layer.ffn_hidden.width);
  SilentFeedForward silent;
  silent.spikes = kernels::LifActivity({config.membrane_decay, config.threshold}, layer.ffn_hidden,
                                       drive, hidden.data());
  silent.update.resize(layer.ffn_output.width);
  kernels::ActiveInputs active;
  silent.products = kernels::Affine(layer.ffn_output, hidden.data(), &active, silent.update.data());
  return silent;
}

// Calls `visit` with the rows of every map.
template <class Visitor>
void VisitRows(PackedWeights* packed, const Visitor& visit) {
  visit(packed->embed_return.rows);
  visit(packed->embed_state.rows);
  visit(packed->embed_action.rows);
  for (PackedLayer& layer : packed->layers) {
    visit(layer.key_value_query.rows);
    visit(layer.routing_hidden.rows);
    visit(layer.routing_gate.rows);
    visit(layer.attention_output.rows);
    visit(layer.ffn_hidden.rows);
    visit(layer.ffn_output.rows);
  }
}

// Calls `visit` with every packed map, its first lane, and the map of `weights` that it was packed
// from.
template <class Visitor>
void VisitMaps(const PackedWeights& packed, Weights* weights, const Visitor& visit) {
  visit(packed.embed_return, 0, weights->embed_return.linear);
  visit(packed.embed_state, 0, weights->embed_state.linear);
  visit(packed.embed_action, 0, weights->embed_action.linear);
  for (size_t i = 0; i < packed.layers.size(); ++i) {
    const PackedLayer& from = packed.layers[i];
    LayerWeights& layer = weights->layers[i];
    const int section = from.key_value_query.width / 3;
    visit(from.key_value_query, 0, layer.key);
    visit(from.key_value_query, section, layer.value);
    visit(from.key_value_query, 2 * section, layer.query);
    if (from.routing_hidden.inputs > 0) {
      visit(from.routing_hidden, 0, layer.routing_hidden);
      visit(from.routing_gate, 0, layer.routing_gate);
    }
    visit(from.attention_output, 0, layer.attention_output);
    visit(from.ffn_hidden, 0, layer.ffn_hidden);
    visit(from.ffn_output, 0, layer.ffn_output);
  }
}

// Copies one map, whose outputs are the lanes of `packed` from `lane` on.
void Unpack(const PackedLinear& packed, int lane, Linear* map) {
  const int outputs = map->weight.shape[0];
  UnpackWeights(packed, lane, &map->weight);
  map->bias.values.assign(packed.bias.begin() + lane, packed.bias.begin() + lane + outputs);
}

}  // namespace

PackedWeights::PackedWeights(const Policy& policy)
    : embed_return(Pack({&policy.weights.embed_return.linear})),
      embed_state(Pack({&policy.weights.embed_state.linear})),
      embed_action(Pack({&policy.weights.embed_action.linear})),
      head_nonzero(NonzeroByInput(policy.weights.head)),
      periods({policy.config.membrane_decay, policy.config.threshold}, policy.config.ticks) {
  kernels::ChooseTarget();  // RunSilently() runs some
  for (const LayerWeights& weights : policy.weights.layers) {
    PackedLayer layer;
    layer.key_value_query = Pack({&weights.key, &weights.value, &weights.query});
    layer.nonzero_query = NonzeroByInput(weights.query);
    if (policy.config.has_routing()) {
      layer.routing_hidden = Pack({&weights.routing_hidden}, kRoutingLanes);
      layer.routing_gate = Pack({&weights.routing_gate}, kRoutingLanes);
      for (int j = 0; j < layer.routing_gate.inputs; ++j) {
        if (layer.routing_hidden.bias[j] > 0.0f) {
          layer.silent_gate_products += layer.routing_gate.nonzero[j];
        }
      }
    }
    layer.attention_output = Pack({&weights.attention_output});
    layer.ffn_hidden = Pack({&weights.ffn_hidden});
    layer.ffn_output = Pack({&weights.ffn_output});
    layer.silent_ffn = RunSilently(policy.config, layer);
    layer.attention_weight = AttentionWeights(policy.config, weights.scale);
    layers.push_back(std::move(layer));
  }
}

absl::Status PackedWeights::ShareRows(const std::string& folder) {
  return spikeserve::ShareRows(folder, [this](const auto& visit) { VisitRows(this, visit); });
}

void PackedWeights::DropFrom(Weights* weights) const {
  VisitMaps(*this, weights, [](const auto&, int, auto& map) {
    Free(&map.weight);
    Free(&map.bias);
  });
}

void PackedWeights::RestoreTo(Weights* weights) const {
  VisitMaps(*this, weights,
            [](const auto& packed, int lane, auto& map) { Unpack(packed, lane, &map); });
}

}  // namespace spikeserve
