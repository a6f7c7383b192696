// The leaky integrate-and-fire neuron, in discrete time.
//
// Pure functions; safe to call from many threads.
#ifndef CORE_NEURON_LIF_H_
#define CORE_NEURON_LIF_H_

namespace spikeserve {

// V <- decay V + I; s = 1[V >= threshold]; V <- 0 where s (eq. 4 and the appendix's discrete form,
// with V_rest = V_reset = 0 and dt/C_m taken into the weights). One multiplication and one addition
// in float32, not fused.
struct Lif {
  float decay = 0.95f;     // 1 - dt/tau_m: 1 ms ticks, 20 ms
  float threshold = 1.0f;  // V_th

  // One tick: updates `membrane` and says whether the neuron fires.
  bool Step(float current, float& membrane) const {
    membrane = decay * membrane + current;
    const bool spike = membrane >= threshold;
    if (spike) membrane = 0.0f;
    return spike;
  }

  // A neuron that starts at zero under a constant current fires first at some tick n, is then where
  // it started, and so fires at n, 2n, 3n, ... Returns n in [1, ticks], or 0 if it stays silent for
  // `ticks` ticks.
  int Period(float current, int ticks) const {
    float membrane = 0.0f;
    for (int tick = 1; tick <= ticks; ++tick) {
      if (Step(current, membrane)) return tick;
    }
    return 0;
  }
};

}  // namespace spikeserve

#endif  // CORE_NEURON_LIF_H_
