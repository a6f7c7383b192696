#include "core/engine/spiking/packed_integers.h"

#include <limits>
#include <utility>

#include "core/engine/spiking/packed_weights.h"

namespace spikeserve {

PackedIntegerPopulation Pack(std::initializer_list<const IntegerPopulation*> populations,
                             int hidden_size) {
  PackedIntegerPopulation packed;
  packed.inputs = (*populations.begin())->weight.shape[1];
  for (const auto* population : populations) {
    packed.width += PadToLanes(population->weight.shape[0]);
  }
  AlignedVector<int8_t> rows(static_cast<size_t>(packed.inputs) * packed.width);
  packed.bias.assign(packed.width, 0);
  packed.silent.assign(packed.width, std::numeric_limits<int16_t>::max());
  packed.nonzero.assign(packed.inputs, 0);
  int lane = 0;
  for (const IntegerPopulation* population : populations) {
    const int outputs = population->weight.shape[0];
    for (int k = 0; k < outputs; ++k) {
      packed.bias[lane + k] = population->bias.values[k];
      packed.silent[lane + k] = static_cast<int16_t>(population->threshold.values[k] - 1);
      for (int j = 0; j < packed.inputs; ++j) {
        const int8_t weight = population->weight.at(k, j);
        rows[static_cast<size_t>(j) * packed.width + lane + k] = weight;
        packed.nonzero[j] += weight != 0;
      }
    }
    packed.outputs = lane + outputs;
    lane += PadToLanes(outputs);
  }
  packed.rows = std::move(rows);
  packed.phase_rows.assign(packed.row(hidden_size), packed.row(packed.inputs));
  return packed;
}

}  // namespace spikeserve
