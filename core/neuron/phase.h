// Defines phase-shifted positional spikes (eq. 4.4).
//
// All functions are pure and thread-safe.
#pragma once

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

// A phase generator of integer arithmetic: the phase in units of 2^-32 turns, modulo one turn.
struct IntegerPhase {
  uint32_t start = 0;          // phi
  uint32_t step = 0;           // omega
  uint32_t step_per_tick = 0;  // omega / T, or omega with the window clock

  // Returns the phase at `tick` (0 ... ticks-1) of a timestep. The window clock has no timestep and
  // counts its ticks from 1.
  uint32_t At(int64_t timestep, uint32_t tick) const {
    return start + static_cast<uint32_t>(timestep) * step + tick * step_per_tick;
  }

  // Returns whether the generator fires: in the first half of a turn.
  static bool Spike(uint32_t phase) { return phase < (uint32_t{1} << 31); }
};

// Returns `radians` in units of 2^-32 turns, rounded to the nearest integer, halves upwards, modulo
// one turn.
inline uint32_t TurnsOf(double radians) {
  const double turns = radians / (2.0 * std::numbers::pi);
  const double fraction = turns - std::floor(turns);
  return static_cast<uint32_t>(static_cast<uint64_t>(std::floor(fraction * 0x1p32 + 0.5)));
}

// Returns the generator with angular frequency omega and phase phi.
inline IntegerPhase MakeIntegerPhase(float omega, float phi, int ticks, bool window_clock) {
  if (window_clock) return {TurnsOf(phi) + TurnsOf(omega), 0, TurnsOf(omega)};
  return {TurnsOf(phi), TurnsOf(omega), TurnsOf(static_cast<double>(omega) / ticks)};
}

}  // namespace spikeserve
