#include "core/model/weights.h"

#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

// Collects the tensor slots of one policy, in the order of the calls of Add.
class SlotList {
 public:
  explicit SlotList(bool has_norms) : has_norms_(has_norms) {}

  template <class Number>
  void Add(std::string name, std::vector<int> shape, BasicTensor<Number>* tensor) {
    slots_.push_back({.name = std::move(name), .shape = std::move(shape), .tensor = tensor});
  }
  void Add(const std::string& name, int out, int in, Linear* linear) {
    Add(name + ".weight", {out, in}, &linear->weight);
    Add(name + ".bias", {out}, &linear->bias);
  }
  void Add(const std::string& name, int out, int in, IntegerPopulation* population) {
    Add(name + ".weight", {out, in}, &population->weight);
    Add(name + ".scale", {out}, &population->scale);
    Add(name + ".bias", {out}, &population->bias);
    Add(name + ".threshold", {out}, &population->threshold);
  }
  void Add(const std::string& name, int size, Norm* norm) {
    if (!has_norms_) return;
    Add(name + ".weight", {size}, &norm->weight);
    Add(name + ".bias", {size}, &norm->bias);
  }
  void Add(const std::string& name, int size, Coder* coder) {
    Add(name + ".gain", {size}, &coder->gain);
    Add(name + ".bias", {size}, &coder->bias);
  }
  void Add(const std::string& name, int size, int inputs, Embedding* embedding) {
    Add(name, size, inputs, &embedding->linear);
    Add(name + ".norm", size, &embedding->norm);
  }

  void Add(const std::string& name, int out, int in, FixedPointMap* map) {
    Add(name + ".weight", {out, in}, &map->weight);
    Add(name + ".shift", {out}, &map->shift);
    Add(name + ".bias", {out}, &map->bias);
  }
  void Add(const std::string& name, int size, FixedPointNorm* norm) {
    if (!has_norms_) return;
    Add(name + ".weight", {size}, &norm->weight);
    Add(name + ".shift", {1}, &norm->shift);
    Add(name + ".bias", {size}, &norm->bias);
  }
  void Add(const std::string& name, int size, int ticks, PeriodCoder* coder) {
    Add(name + ".sign", {size}, &coder->sign);
    Add(name + ".threshold", {size, ticks}, &coder->threshold);
  }
  void Add(const std::string& name, int size, int inputs, FixedPointEmbedding* embedding) {
    Add(name, size, inputs, &embedding->linear);
    Add(name + ".norm", size, &embedding->norm);
  }

  std::vector<TensorSlot> Take() { return std::move(slots_); }

 private:
  const bool has_norms_;  // policies without norms have no tensors of norms
  std::vector<TensorSlot> slots_;
};

void AddLayer(const ModelConfig& config, const std::string& name, LayerWeights* layer,
              SlotList* slots) {
  const int d = config.hidden_size;
  const std::string attention = name + ".attention";
  if (!config.is_dense()) slots->Add(name + ".coder", d, &layer->coder);
  slots->Add(attention + ".query", d, config.attention_inputs(), &layer->query);
  slots->Add(attention + ".key", d, config.attention_inputs(), &layer->key);
  slots->Add(attention + ".value", d, config.attention_inputs(), &layer->value);
  if (!config.is_dense()) slots->Add(attention + ".scale", {config.heads}, &layer->scale);
  if (config.has_routing()) {
    const int m = config.routing_hidden_size;
    slots->Add(name + ".routing.hidden", m, d, &layer->routing_hidden);
    slots->Add(name + ".routing.gate", config.heads, m, &layer->routing_gate);
  }
  slots->Add(attention + ".output", d, config.merged_size(), &layer->attention_output);
  slots->Add(attention + ".norm", d, &layer->attention_norm);
  if (!config.is_dense()) slots->Add(name + ".ffn.coder", d, &layer->ffn_coder);
  slots->Add(name + ".ffn.hidden", config.ffn_size, d, &layer->ffn_hidden);
  slots->Add(name + ".ffn.output", d, config.ffn_size, &layer->ffn_output);
  slots->Add(name + ".ffn.norm", d, &layer->ffn_norm);
}

void AddIntegerLayer(const ModelConfig& config, const std::string& name, LayerWeights* layer,
                     SlotList* slots) {
  const int d = config.hidden_size;
  const std::string attention = name + ".attention";
  FixedPointLayer& fixed = layer->fixed_point;
  slots->Add(name + ".coder", d, config.ticks, &fixed.coder);
  slots->Add(attention + ".query", d, config.attention_inputs(), &layer->integer.query);
  slots->Add(attention + ".key", d, config.attention_inputs(), &layer->integer.key);
  slots->Add(attention + ".value", d, config.attention_inputs(), &layer->integer.value);
  slots->Add(attention + ".scale", {config.heads}, &fixed.attention_scale);
  if (config.has_routing()) {
    const int m = config.routing_hidden_size;
    slots->Add(name + ".routing.hidden", m, d, &fixed.routing_hidden);
    slots->Add(name + ".routing.gate", config.heads, m, &fixed.routing_gate);
  }
  slots->Add(attention + ".output", d, config.merged_size(), &fixed.attention_output);
  slots->Add(attention + ".norm", d, &fixed.attention_norm);
  slots->Add(name + ".ffn.coder", d, config.ticks, &fixed.ffn_coder);
  slots->Add(name + ".ffn.hidden", config.ffn_size, d, &layer->integer.ffn_hidden);
  slots->Add(name + ".ffn.output", d, config.ffn_size, &fixed.ffn_output);
  slots->Add(name + ".ffn.norm", d, &fixed.ffn_norm);
}

void AddDenseIntegerLayer(const ModelConfig& config, const std::string& name, LayerWeights* layer,
                          SlotList* slots) {
  const int d = config.hidden_size;
  const std::string attention = name + ".attention";
  FixedPointLayer& fixed = layer->fixed_point;
  slots->Add(attention + ".query", d, d, &fixed.query);
  slots->Add(attention + ".key", d, d, &fixed.key);
  slots->Add(attention + ".value", d, d, &fixed.value);
  slots->Add(attention + ".output", d, d, &fixed.attention_output);
  slots->Add(attention + ".norm", d, &fixed.attention_norm);
  slots->Add(name + ".ffn.hidden", config.ffn_size, d, &fixed.ffn_hidden);
  slots->Add(name + ".ffn.output", d, config.ffn_size, &fixed.ffn_output);
  slots->Add(name + ".ffn.norm", d, &fixed.ffn_norm);
}

// Returns the function that adds the tensors of a layer.
auto LayerAdder(const ModelConfig& config) {
  if (!config.is_integer()) return AddLayer;
  return config.is_dense() ? AddDenseIntegerLayer : AddIntegerLayer;
}

// Adds the embeddings of `ends`, which are the Weights themselves or their FixedPointEnds.
void AddEmbeddings(int d, int state_inputs, int action_size, auto* ends, SlotList* slots) {
  slots->Add("embed.return", d, 1, &ends->embed_return);
  slots->Add("embed.state", d, state_inputs, &ends->embed_state);
  slots->Add("embed.action", d, action_size, &ends->embed_action);
}

}  // namespace

std::vector<TensorSlot> TensorSlots(const ModelConfig& config, int observation_size,
                                    int action_size, Weights* weights) {
  const int d = config.hidden_size;
  SlotList slots(config.has_norms());
  const int state_inputs = config.state_inputs(observation_size);
  if (config.is_integer()) {
    AddEmbeddings(d, state_inputs, action_size, &weights->fixed_point, &slots);
  } else {
    AddEmbeddings(d, state_inputs, action_size, weights, &slots);
  }
  if (config.is_dense() && config.is_integer()) {
    slots.Add("embed.timestep.weight", {-1, d}, &weights->fixed_point.embed_timestep);
  } else if (config.is_dense()) {
    slots.Add("embed.timestep.weight", {-1, d}, &weights->embed_timestep);
  }
  if (config.has_phase()) {
    slots.Add("phase.omega", {config.heads}, &weights->phase_omega);
    slots.Add("phase.phi", {config.heads}, &weights->phase_phi);
  }
  weights->layers.resize(config.layers);
  for (int i = 0; i < config.layers; ++i) {
    LayerAdder(config)(config, absl::StrCat("layers.", i), &weights->layers[i], &slots);
  }
  if (!config.is_dense() && config.is_integer()) {
    slots.Add("readout.coder", d, config.ticks, &weights->fixed_point.readout_coder);
  } else if (!config.is_dense()) {
    slots.Add("readout.coder", d, &weights->readout_coder);
  }
  slots.Add("head", action_size, d, &weights->head);
  slots.Add("observation.mean", {observation_size}, &weights->observation_mean);
  slots.Add("observation.std", {observation_size}, &weights->observation_std);
  if (config.observation_changes) {
    slots.Add("observation.change_std", {observation_size}, &weights->observation_change_std);
  }
  return slots.Take();
}

}  // namespace spikeserve
