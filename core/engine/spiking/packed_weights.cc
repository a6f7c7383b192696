#include "core/engine/spiking/packed_weights.h"

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "core/engine/spiking/attention_cache.h"
#include "core/engine/spiking/kernels/drive.h"
#include "core/engine/spiking/kernels/integer_kernels.h"
#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/kernels/linear_kernels.h"
#include "core/engine/spiking/packed/packed_rows.h"
#include "core/engine/spiking/packed/ring_biases.h"
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

template <class Arithmetic>
SilentFeedForward RunSilently(const ModelConfig& config, const PackedLayer<Arithmetic>& layer) {
  kernels::Drive<typename Arithmetic::Current> drive;
  drive.ticks = config.ticks;
  drive.offsets.assign(static_cast<size_t>(config.ticks) + 1, 0);
  AlignedVector<typename Arithmetic::Activity> hidden(layer.ffn_hidden.width);
  SilentFeedForward silent;
  silent.spikes =
      kernels::LifActivity(Arithmetic::NeuronOf(config), layer.ffn_hidden, drive, hidden.data());
  silent.update.resize(layer.ffn_output.width);
  kernels::ActiveInputs active;
  silent.products = kernels::Affine(layer.ffn_output, hidden.data(), &active, silent.update.data());
  return silent;
}

// Calls `visit` with the rows of every map.
template <class Arithmetic, class Visitor>
void VisitRows(PackedWeights<Arithmetic>* packed, const Visitor& visit) {
  visit(packed->embed_return.rows);
  visit(packed->embed_state.rows);
  visit(packed->embed_action.rows);
  for (PackedLayer<Arithmetic>& layer : packed->layers) {
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
template <class Arithmetic, class Visitor>
void VisitMaps(const PackedWeights<Arithmetic>& packed, Weights* weights, const Visitor& visit) {
  visit(packed.embed_return, 0, weights->embed_return.linear);
  visit(packed.embed_state, 0, weights->embed_state.linear);
  visit(packed.embed_action, 0, weights->embed_action.linear);
  for (size_t i = 0; i < packed.layers.size(); ++i) {
    const PackedLayer<Arithmetic>& from = packed.layers[i];
    LayerWeights& layer = weights->layers[i];
    auto& maps = Arithmetic::MapsOf(layer);
    const int section = from.key_value_query.width / 3;
    visit(from.key_value_query, 0, maps.key);
    visit(from.key_value_query, section, maps.value);
    visit(from.key_value_query, 2 * section, maps.query);
    if (from.routing_hidden.inputs > 0) {
      visit(from.routing_hidden, 0, layer.routing_hidden);
      visit(from.routing_gate, 0, layer.routing_gate);
    }
    visit(from.attention_output, 0, layer.attention_output);
    visit(from.ffn_hidden, 0, maps.ffn_hidden);
    visit(from.ffn_output, 0, maps.ffn_output);
  }
}

// Copies one map, whose outputs are the lanes of `packed` from `lane` on.
template <class Packed, class Map>
void Unpack(const Packed& packed, int lane, Map* map) {
  const int outputs = map->weight.shape[0];
  UnpackWeights(packed, lane, &map->weight);
  map->bias.values.assign(packed.bias.begin() + lane, packed.bias.begin() + lane + outputs);
  if constexpr (requires { map->threshold; }) {
    const auto* const silent = packed.silent.data() + lane;
    map->threshold.values.clear();
    for (int k = 0; k < outputs; ++k) {
      map->threshold.values.push_back(static_cast<int16_t>(silent[k] + 1));
    }
  }
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
      layer.routing_hidden = Pack({&weights.routing_hidden}, kRoutingLanes);
      layer.routing_gate = Pack({&weights.routing_gate}, kRoutingLanes);
      for (int j = 0; j < layer.routing_gate.inputs; ++j) {
        if (layer.routing_hidden.bias[j] > 0.0f) {
          layer.silent_gate_products += layer.routing_gate.nonzero[j];
        }
      }
    }
    layer.attention_output = Pack({&weights.attention_output});
    layer.ffn_hidden = Arithmetic::PackPopulations({&maps.ffn_hidden}, d);
    layer.ffn_output = Arithmetic::PackOutput(maps.ffn_output, policy.config.ticks);
    layer.silent_ffn = RunSilently(policy.config, layer);
    layer.attention_weight = AttentionWeights(policy.config, weights.scale);
    if (policy.config.relative_bias) {
      layer.attention_bias = RingBiases(weights.relative, AttentionBand(policy.config).slots());
    }
    layers.push_back(std::move(layer));
  }
}

template <class Arithmetic>
absl::Status PackedWeights<Arithmetic>::ShareRows(const std::string& folder) {
  return spikeserve::ShareRows(folder, [this](const auto& visit) { VisitRows(this, visit); });
}

template <class Arithmetic>
void PackedWeights<Arithmetic>::DropFrom(Weights* weights) const {
  VisitMaps(*this, weights, [](const auto&, int, auto& map) {
    Free(&map.weight);
    Free(&map.bias);
    if constexpr (requires { map.threshold; }) Free(&map.threshold);
  });
}

template <class Arithmetic>
void PackedWeights<Arithmetic>::RestoreTo(Weights* weights) const {
  VisitMaps(*this, weights,
            [](const auto& packed, int lane, auto& map) { Unpack(packed, lane, &map); });
}

template struct PackedWeights<Float32Arithmetic>;
template struct PackedWeights<Int8Arithmetic>;

}  // namespace spikeserve
