// Defines the leaky integrate-and-fire (LIF) neuron in 16-bit integers.
//
// All functions are pure and thread-safe.
#ifndef CORE_NEURON_INTEGER_LIF_H_
#define CORE_NEURON_INTEGER_LIF_H_

#include <algorithm>
#include <cstdint>
#include <limits>

namespace spikeserve {

// The update rule of lif.h in fixed point. Membranes, currents and thresholds are in units of the
// neuron's scale (core/model/integer_weights.h):
//
//   V <- sat16(((decay V + 16384) >> 15) + I);  s = 1[V >= threshold];  V <- 0 if s = 1
//
// The product has 32 bits, the shift is arithmetic, and sat16 clamps to [-32768, 32767]. The
// rounded product is what processors call a rounding Q15 multiplication.
struct IntegerLif {
  int16_t decay = 31130;  // 1 - dt/tau_m in units of 1 / 32768; >= 0

  // Advances `membrane` by one tick. Returns whether the neuron fires.
  bool Step(int16_t current, int16_t threshold, int16_t& membrane) const {
    const int leaked = (int{decay} * membrane + (1 << 14)) >> 15;
    using Limits = std::numeric_limits<int16_t>;
    const int charged = std::clamp(leaked + current, int{Limits::min()}, int{Limits::max()});
    const bool spike = charged >= threshold;
    membrane = spike ? int16_t{0} : static_cast<int16_t>(charged);
    return spike;
  }
};

}  // namespace spikeserve

#endif  // CORE_NEURON_INTEGER_LIF_H_
