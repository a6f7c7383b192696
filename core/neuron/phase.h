// Phase-shifted positional spikes (eq. 4.4).
//
// Pure functions; safe to call from many threads.
#ifndef CORE_NEURON_PHASE_H_
#define CORE_NEURON_PHASE_H_

#include <cmath>
#include <cstdint>
#include <numbers>

namespace spikeserve {

// The generators' time at tick index `tick` (0 ... ticks-1) of a timestep: the clock that carries
// position.
inline double TimestepPhaseTime(int64_t timestep, int tick, int ticks) {
  return static_cast<double>(timestep) + static_cast<double>(tick) / ticks;
}

// The literal clock of eq. 4.5, t in {1, ..., T}: the same for every token.
inline double WindowPhaseTime(int tick) { return tick + 1.0; }

// s(tau) = 1[sin(omega tau + phi) > 0]. The sign is read from the fraction of a turn, which needs
// no sine and so is the same on every machine.
inline bool PhaseSpike(float omega, float phi, double tau) {
  const double turns =
      (static_cast<double>(omega) * tau + static_cast<double>(phi)) / (2.0 * std::numbers::pi);
  const double fraction = turns - std::floor(turns);
  return fraction > 0.0 && fraction < 0.5;
}

}  // namespace spikeserve

#endif  // CORE_NEURON_PHASE_H_
