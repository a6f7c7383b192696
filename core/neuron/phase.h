// Defines phase-shifted positional spikes (eq. 4.4).
//
// All functions are pure and thread-safe.
#ifndef CORE_NEURON_PHASE_H_
#define CORE_NEURON_PHASE_H_

#include <cmath>
#include <cstdint>
#include <numbers>

namespace spikeserve {

// Returns the time tau of the generators at `tick` (0 ... ticks-1) of a timestep. This clock
// encodes the position of the timestep in the episode.
inline double TimestepPhaseTime(int64_t timestep, int tick, int ticks) {
  return static_cast<double>(timestep) + static_cast<double>(tick) / ticks;
}

// Returns the time tau of eq. 4.5's literal clock, which runs over {1, ..., T} for every token and
// so encodes no position. `tick` counts from 0.
inline double WindowPhaseTime(int tick) { return tick + 1.0; }

// Returns s(tau) = 1[sin(omega tau + phi) > 0]. Reads the sign of the sine from the fractional part
// of the phase in turns: a library's sine may differ between machines.
inline bool PhaseSpike(float omega, float phi, double tau) {
  const double turns =
      (static_cast<double>(omega) * tau + static_cast<double>(phi)) / (2.0 * std::numbers::pi);
  const double fraction = turns - std::floor(turns);
  return fraction > 0.0 && fraction < 0.5;
}

}  // namespace spikeserve

#endif  // CORE_NEURON_PHASE_H_
