#include "core/engine/spiking/packed_weights.h"

#include <cmath>
#include <cstddef>
#include <memory>
#include <utility>

#include "absl/status/statusor.h"
#include "core/base/shared_bytes.h"
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

size_t NextCacheLine(size_t offset) {
  const auto line = static_cast<size_t>(kCacheLine);
  return (offset + line - 1) / line * line;
}

// Frees the memory, which clear() would keep.
template <class Number>
void Free(BasicTensor<Number>* matrix) {
  matrix->values = std::vector<Number>();
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

template <class Arithmetic>
absl::Status PackedWeights<Arithmetic>::ShareRows(const std::string& folder) {
  std::string bytes;
  VisitRows(this, [&](const auto& rows) {
    bytes.resize(NextCacheLine(bytes.size()));
    bytes.append(reinterpret_cast<const char*>(rows.data()), rows.bytes());
  });
  const absl::StatusOr<std::shared_ptr<const char>> shared = ShareBytes(folder, bytes);
  if (!shared.ok()) return shared.status();
  size_t offset = 0;
  VisitRows(this, [&](auto& rows) {
    offset = NextCacheLine(offset);
    rows.MoveTo({*shared, reinterpret_cast<decltype(rows.data())>(shared->get() + offset)});
    offset += rows.bytes();
  });
  return absl::OkStatus();
}

void DropPackedMatrices(Arithmetic arithmetic, Weights* weights) {
  Free(&weights->embed_return.linear.weight);
  Free(&weights->embed_state.linear.weight);
  Free(&weights->embed_action.linear.weight);
  for (LayerWeights& layer : weights->layers) {
    VisitMaps(arithmetic, layer, [](auto& maps) {
      Free(&maps.query.weight);
      Free(&maps.key.weight);
      Free(&maps.value.weight);
      Free(&maps.ffn_hidden.weight);
      Free(&maps.ffn_output.weight);
    });
    Free(&layer.routing_hidden.weight);
    Free(&layer.routing_gate.weight);
    Free(&layer.attention_output.weight);
  }
}

template struct PackedWeights<Float32Arithmetic>;
template struct PackedWeights<Int8Arithmetic>;

}  // namespace spikeserve
