// Lists the types that the streaming engine uses for each arithmetic of the spike-driven parts.
//
// The engine is a template over these lists; the kernels are overloaded for their types.
#ifndef CORE_ENGINE_SPIKING_ARITHMETIC_H_
#define CORE_ENGINE_SPIKING_ARITHMETIC_H_

#include <cstdint>
#include <initializer_list>

#include "core/engine/spiking/packed/packed_linear.h"
#include "core/engine/spiking/packed_integers.h"
#include "core/model/policy.h"
#include "core/neuron/integer_lif.h"
#include "core/neuron/lif.h"

namespace spikeserve {

struct Float32Arithmetic {
  using Neuron = Lif;
  using Current = float;
  using Population = PackedLinear;
  using Output = PackedLinear;
  using Activity = float;  // of a hidden neuron over the ticks of a token: spike count / T

  static auto& MapsOf(auto& layer) { return layer; }  // a LayerWeights, const or not
  static Neuron NeuronOf(const ModelConfig& config) {
    return {config.membrane_decay, config.threshold};
  }
  static Population PackPopulations(std::initializer_list<const Linear*> linears,
                                    int /*hidden_size*/) {
    return Pack(linears);
  }
  static Output PackOutput(const Linear& linear, int /*ticks*/) { return Pack({&linear}); }
};

struct Int8Arithmetic {
  using Neuron = IntegerLif;
  using Current = int16_t;
  using Population = PackedIntegerPopulation;
  using Output = PackedIntegerOutput;
  using Activity = int16_t;  // of a hidden neuron over the ticks of a token: spike count

  static auto& MapsOf(auto& layer) { return layer.integer; }
  static Neuron NeuronOf(const ModelConfig& config) {
    return {static_cast<int16_t>(config.integer_decay())};
  }
  static Population PackPopulations(std::initializer_list<const IntegerPopulation*> populations,
                                    int hidden_size) {
    return Pack(populations, hidden_size);
  }
  static Output PackOutput(const IntegerOutput& output, int ticks) { return Pack(output, ticks); }
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_ARITHMETIC_H_
