#include "core/engine/spiking/packed/packed_linear.h"

#include <utility>

namespace spikeserve {

PackedLinear Pack(std::initializer_list<const Linear*> linears, int lanes) {
  PackedLinear packed;
  packed.inputs = (*linears.begin())->weight.shape[1];
  for (const Linear* linear : linears) packed.width += PadToLanes(linear->weight.shape[0], lanes);
  AlignedVector<float> rows(static_cast<size_t>(packed.inputs) * packed.width);
  packed.bias.assign(packed.width, 0.0f);
  packed.nonzero.assign(packed.inputs, 0);
  int lane = 0;
  for (const Linear* linear : linears) {
    const int outputs = linear->weight.shape[0];
    for (int i = 0; i < outputs; ++i) {
      packed.bias[lane + i] = linear->bias.values[i];
      for (int j = 0; j < packed.inputs; ++j) {
        rows[static_cast<size_t>(j) * packed.width + lane + i] = linear->weight.at(i, j);
      }
    }
    const std::vector<uint32_t> nonzero = NonzeroByInput(*linear);
    for (int j = 0; j < packed.inputs; ++j) packed.nonzero[j] += nonzero[j];
    packed.outputs = lane + outputs;
    lane += PadToLanes(outputs, lanes);
  }
  packed.rows = std::move(rows);
  return packed;
}

}  // namespace spikeserve
