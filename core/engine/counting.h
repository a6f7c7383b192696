// Counts spikes and synaptic operations one by one. This is the definition of the numbers in Counts
// (counts.h): an engine that counts faster must give equal numbers.
//
// As in NeuroBench, a product is counted if both factors are nonzero, and biases are not counted.
//
//   counts.spikes(Stage::kCoder) += CountSpikes(spikes);
//   counts.accumulates += CountProducts(weights.query, spikes[tick]);
//
// All functions are pure and thread-safe.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "core/engine/trace.h"
#include "core/math/tensor.h"

namespace spikeserve {

// Returns the number of spikes in `train`.
inline uint64_t CountSpikes(const SpikeTrain& train) {
  uint64_t count = 0;
  for (const auto& tick : train) count += std::count(tick.begin(), tick.end(), 1);
  return count;
}

// Returns the number of nonzero weights of `map` (a Linear or an IntegerPopulation) that meet a
// nonzero element of `input`, which is an array of [in] spikes or analog values.
uint64_t CountProducts(const auto& map, const auto& input) {
  uint64_t count = 0;
  for (size_t i = 0; i < map.bias.values.size(); ++i) {
    for (size_t j = 0; j < input.size(); ++j) {
      count += input[j] != 0 && map.weight.at(static_cast<int>(i), static_cast<int>(j)) != 0;
    }
  }
  return count;
}

}  // namespace spikeserve
