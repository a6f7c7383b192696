#include "core/engine/spiking/packed/packed_fixed_point.h"

#include <algorithm>
#include <utility>

#include "core/engine/spiking/packed/packed_linear.h"

namespace spikeserve {

PackedFixedPointMap Pack(const FixedPointMap& map) {
  const int outputs = map.weight.shape[0];
  PackedFixedPointMap packed;
  packed.inputs = map.weight.shape[1];
  packed.width = PadToLanes(outputs);
  AlignedVector<int8_t> rows(static_cast<size_t>(PadToLanes(packed.inputs)) * packed.width);
  for (auto* lanes : {&packed.left, &packed.rounding, &packed.right, &packed.bias}) {
    lanes->assign(packed.width, 0);
  }
  packed.nonzero.assign(PadToLanes(packed.inputs), 0);
  for (int k = 0; k < outputs; ++k) {
    const int shift = map.shift.values[k];
    packed.left[k] = std::max(-shift, 0);
    packed.right[k] = std::max(shift, 0);
    packed.rounding[k] = shift > 0 ? int32_t{1} << (shift - 1) : 0;
    packed.bias[k] = map.bias.values[k];
    for (int j = 0; j < packed.inputs; ++j) {
      const int8_t weight = map.weight.at(k, j);
      rows[(static_cast<size_t>(j / 2) * packed.width + k) * 2 + j % 2] = weight;
      packed.nonzero[j] = static_cast<int16_t>(packed.nonzero[j] + (weight != 0));
    }
  }
  packed.rows = std::move(rows);
  return packed;
}

PackedNorm Pack(const FixedPointNorm& norm) {
  PackedNorm packed;
  if (norm.weight.shape.empty()) return packed;
  packed.size = norm.weight.shape[0];
  packed.width = PadToLanes(packed.size);
  packed.shift = norm.shift.values[0];
  packed.weight.assign(norm.weight.values.begin(), norm.weight.values.end());
  packed.bias.assign(norm.bias.values.begin(), norm.bias.values.end());
  for (auto* lanes : {&packed.weight, &packed.bias}) lanes->resize(packed.width, 0);
  return packed;
}

PackedPeriodCoder Pack(const PeriodCoder& coder) {
  PackedPeriodCoder packed;
  packed.neurons = coder.threshold.shape[0];
  packed.ticks = coder.threshold.shape[1];
  packed.width = PadToLanes(packed.neurons);
  packed.sign.assign(packed.width, 0);
  packed.threshold.assign(static_cast<size_t>(packed.ticks) * packed.width, kLargestResidual);
  for (int j = 0; j < packed.neurons; ++j) {
    packed.sign[j] = coder.sign.values[j];
    for (int n = 0; n < packed.ticks; ++n) {
      packed.threshold[static_cast<size_t>(n) * packed.width + j] = coder.threshold.at(j, n);
    }
  }
  return packed;
}

}  // namespace spikeserve
