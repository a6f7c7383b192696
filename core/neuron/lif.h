// Defines the leaky integrate-and-fire (LIF) neuron in discrete time.
//
// All functions are pure and thread-safe.
#pragma once

namespace spikeserve {

// The parameters and the update rule of a neuron (eq. 4 and the appendix's discrete form, with
// V_rest = V_reset = 0 and with dt/C_m absorbed into the weights):
//
//   V <- decay V + I;  s = 1[V >= threshold];  V <- 0 if s = 1
//
// The update uses one float32 multiplication and one addition, which are not fused, so that every
// processor gives equal bits.
struct Lif {
  float decay = 0.95f;     // 1 - dt/tau_m, for ticks of 1 ms and tau_m = 20 ms
  float threshold = 1.0f;  // V_th

  // Advances `membrane` by one tick. Returns whether the neuron fires.
  bool Step(float current, float& membrane) const {
    membrane = decay * membrane + current;
    const bool spike = membrane >= threshold;
    if (spike) membrane = 0.0f;
    return spike;
  }

  // Returns the tick n in [1, ticks] at which a neuron that starts at V = 0 first fires under a
  // constant current, or 0 if it does not fire within `ticks` ticks. The reset restores V = 0, so
  // the neuron fires at n, 2n, 3n, ...
  int Period(float current, int ticks) const {
    float membrane = 0.0f;
    for (int tick = 1; tick <= ticks; ++tick) {
      if (Step(current, membrane)) return tick;
    }
    return 0;
  }
};

}  // namespace spikeserve
