// From an analog value to spikes. The rate coder is a LIF neuron under the constant current
// x * gain + bias, whose train is its period (lif.h, period_table.h); here is the Bernoulli coder,
// kept as the paper's alternative.
//
// Pure functions; safe to call from many threads.
#ifndef CORE_NEURON_CODER_H_
#define CORE_NEURON_CODER_H_

#include <cstdint>

#include "core/math/counter_random.h"
#include "core/math/exp.h"

namespace spikeserve {

// Which draw of the Bernoulli coder: a key of its counter-based generator.
struct BernoulliKey {
  uint64_t seed = 0;
  int64_t timestep = 0;
  int token = 0;  // 0 return-to-go, 1 state, 2 action
  int site = 0;   // 2 l attention coder of layer l, 2 l + 1 its FFN coder, 2 L readout coder
};

// Fires with probability sigmoid(x * gain + bias), independently per neuron and tick (tick = 0 ...
// T-1).
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
