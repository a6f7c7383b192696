// Defines the leaky integrate-and-fire (LIF) neuron of integer arithmetic, which fires only in
// response to an input spike.
//
// All functions are pure and thread-safe.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>

namespace spikeserve {

// The update rule. At every tick the membrane leaks and integrates the bias:
//
//   V <- sat16(V - leak(V) + b);  leak(V) = V * leak / 256, rounded to the nearest integer, halves
//   up
//
// At a tick at which at least one neuron of the input fires, it then integrates the input and may
// fire. At other ticks it cannot fire, so a membrane needs no update until the next input spike:
//
//   V <- sat16(V + I);  s = 1[V >= threshold];  V <- 0 if s = 1
//
// sat16 clamps to [-32768, 32767].
struct ShiftLif {
  int leak = 16;  // of 256 at every tick, 0 to 128

  // Leaks and integrates the bias for one tick.
  void Leak(int16_t bias, int16_t& membrane) const {
    membrane = Saturate(membrane - ((membrane * leak + 128) >> 8) + bias);
  }

  // Integrates the input spikes of the tick that Leak() has reached. Returns whether the neuron
  // fires.
  static bool Charge(int16_t current, int16_t threshold, int16_t& membrane) {
    membrane = Saturate(membrane + current);
    const bool spike = membrane >= threshold;
    if (spike) membrane = 0;
    return spike;
  }

 private:
  static int16_t Saturate(int value) {
    using Limits = std::numeric_limits<int16_t>;
    return static_cast<int16_t>(std::clamp<int>(value, Limits::min(), Limits::max()));
  }
};

}  // namespace spikeserve
