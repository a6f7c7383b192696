// Arranges biases by distance for attention over a ring of tokens.
//
// Pure function; thread-safe.
#pragma once

#include <cstddef>
#include <vector>

#include "core/math/tensor.h"

namespace spikeserve {

// Returns the biases `relative` [H, distances] for a ring of `slots` slots, at least as many as
// distances: [H][2 slots], where entry i is the bias of the distance (2 slots - 1 - i) mod slots,
// or 0 beyond the last one. If the newest token is in slot `last`, the bias of the token in slot s
// is entry slots - 1 - last + s, for every s.
template <class Number>
std::vector<Number> RingBiases(const BasicTensor<Number>& relative, int slots) {
  const int distances = relative.shape[1];
  std::vector<Number> biases;
  for (int head = 0; head < relative.shape[0]; ++head) {
    for (int i = 0; i < 2 * slots; ++i) {
      const int distance = (2 * slots - 1 - i) % slots;
      biases.push_back(distance < distances ? relative.at(head, distance) : Number{0});
    }
  }
  return biases;
}

}  // namespace spikeserve
