#include "core/engine/spiking/packed_integer_policy.h"

#include <utility>

#include "core/engine/spiking/packed/packed_linear.h"
#include "core/engine/spiking/packed/packed_rows.h"

namespace spikeserve {
namespace {

std::vector<IntegerPhase> Phases(const Policy& policy) {
  std::vector<IntegerPhase> phases;
  for (int k = 0; policy.config.has_phase() && k < policy.config.heads; ++k) {
    phases.push_back(MakeIntegerPhase(policy.weights.phase_omega.values[k],
                                      policy.weights.phase_phi.values[k], policy.config.ticks,
                                      policy.config.phase_clock == PhaseClock::kWindow));
  }
  return phases;
}

PackedEmbedding PackEmbedding(const FixedPointEmbedding& embedding) {
  return {Pack(embedding.linear), Pack(embedding.norm)};
}

// Calls `visit` with every map whose weights DropFrom() frees: packed, its first lane, and the
// weights.
template <class Visitor>
void VisitWeights(const PackedIntegerPolicy& packed, Weights* weights, const Visitor& visit) {
  for (size_t i = 0; i < packed.layers.size(); ++i) {
    const PackedIntegerLayer& from = packed.layers[i];
    LayerWeights& layer = weights->layers[i];
    const int section = from.key_value_query.width / 3;
    visit(from.key_value_query, 0, &layer.integer.key.weight);
    visit(from.key_value_query, section, &layer.integer.value.weight);
    visit(from.key_value_query, 2 * section, &layer.integer.query.weight);
    visit(from.attention_output, 0, &layer.fixed_point.attention_output.weight);
    visit(from.ffn_hidden, 0, &layer.integer.ffn_hidden.weight);
    visit(from.ffn_output, 0, &layer.fixed_point.ffn_output.weight);
  }
}

}  // namespace

PackedIntegerPolicy::PackedIntegerPolicy(const Policy& policy)
    : embed_return(PackEmbedding(policy.weights.fixed_point.embed_return)),
      embed_state(PackEmbedding(policy.weights.fixed_point.embed_state)),
      embed_action(PackEmbedding(policy.weights.fixed_point.embed_action)),
      phases(Phases(policy)),
      readout_coder(Pack(policy.weights.fixed_point.readout_coder)),
      head_nonzero(NonzeroByInput(policy.weights.head)) {
  const int d = policy.config.hidden_size;
  for (const LayerWeights& weights : policy.weights.layers) {
    const IntegerMaps& maps = weights.integer;
    const FixedPointLayer& fixed = weights.fixed_point;
    PackedIntegerLayer layer;
    layer.coder = Pack(fixed.coder);
    layer.key_value_query = Pack({&maps.key, &maps.value, &maps.query}, d);
    layer.nonzero_key_value = NonzeroByInput(maps.key);
    const std::vector<uint32_t> values = NonzeroByInput(maps.value);
    for (size_t i = 0; i < values.size(); ++i) layer.nonzero_key_value[i] += values[i];
    if (policy.config.has_routing()) {
      layer.routing_hidden = Pack(fixed.routing_hidden);
      layer.routing_gate = Pack(fixed.routing_gate);
    }
    layer.attention_output = Pack(fixed.attention_output);
    layer.attention_norm = Pack(fixed.attention_norm);
    layer.ffn_coder = Pack(fixed.ffn_coder);
    layer.ffn_hidden = Pack({&maps.ffn_hidden}, d);
    layer.ffn_output = Pack(fixed.ffn_output);
    layer.ffn_norm = Pack(fixed.ffn_norm);
    layers.push_back(std::move(layer));
  }
}

absl::Status PackedIntegerPolicy::ShareRows(const std::string& folder) {
  return spikeserve::ShareRows(folder, [this](const auto& visit) {
    visit(embed_return.linear.rows);
    visit(embed_state.linear.rows);
    visit(embed_action.linear.rows);
    for (PackedIntegerLayer& layer : layers) {
      visit(layer.key_value_query.rows);
      visit(layer.routing_hidden.rows);
      visit(layer.routing_gate.rows);
      visit(layer.attention_output.rows);
      visit(layer.ffn_hidden.rows);
      visit(layer.ffn_output.rows);
    }
  });
}

void PackedIntegerPolicy::DropFrom(Weights* weights) const {
  VisitWeights(*this, weights, [](const auto&, int, auto* weight) { Free(weight); });
}

void PackedIntegerPolicy::RestoreTo(Weights* weights) const {
  VisitWeights(*this, weights, [](const auto& packed, int lane, auto* weight) {
    UnpackWeights(packed, lane, weight);
  });
}

}  // namespace spikeserve
