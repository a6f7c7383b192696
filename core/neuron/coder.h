// Converts analog values to spikes.
//
// The rate coder needs no function of its own: it is a LIF neuron under the constant current
// x * gain + bias, whose spike train is determined by its period (lif.h, period_table.h). This file
// defines the Bernoulli coder, the paper's alternative.
//
// All functions are pure and thread-safe.
#ifndef CORE_NEURON_CODER_H_
#define CORE_NEURON_CODER_H_

#include <cstdint>

#include "core/math/counter_random.h"
#include "core/math/exp.h"

namespace spikeserve {

// Identifies one coder of one token. Together with a neuron and a tick, it is the key of a draw
// from the counter-based generator (counter_random.h).
struct BernoulliKey {
  uint64_t seed = 0;
  int64_t timestep = 0;
  int token = 0;  // 0: return-to-go, 1: state, 2: action
  int site = 0;   // 2 l: attention coder of layer l, 2 l + 1: its FFN coder, 2 L: readout coder
};

// Returns whether a neuron fires at `tick` (0 ... T-1). The probability is
// sigmoid(x * gain + bias), independently for each neuron and tick.
inline bool BernoulliSpike(const BernoulliKey& key, int neuron, int tick, float x, float gain,
                           float bias) {
  const uint64_t bits =
      RandomBits({key.seed, static_cast<uint64_t>(key.timestep), static_cast<uint64_t>(key.token),
                  static_cast<uint64_t>(key.site), static_cast<uint64_t>(neuron),
                  static_cast<uint64_t>(tick)});
  return UniformFloat(bits) < Sigmoid(x * gain + bias);
}

}  // namespace spikeserve

#endif  // CORE_NEURON_CODER_H_
