// Tells an observation from what a robot passes in its place. Allocates no memory for it, so that
// a control step can.
//
// Free functions, safe to call from many threads.
#pragma once

#include <cmath>
#include <cstddef>
#include <span>
#include <string>

namespace spikeserve::robot {

// Why an observation is not valid.
struct InvalidObservation {
  size_t expected = 0;  // numbers
  size_t received = 0;
  size_t element = 0;  // of the first number that is not finite, if the size is right
  float value = 0.0f;

  // Returns "field: expected X, received Y".
  std::string ToString() const {
    if (received != expected) {
      return "observation: expected " + std::to_string(expected) + " numbers, received " +
             std::to_string(received);
    }
    const char* const number = std::isnan(value) ? "nan" : value < 0.0f ? "-inf" : "inf";
    return "observation[" + std::to_string(element) + "]: expected a finite number, received " +
           number;
  }
};

// Returns whether `observation` has `size` numbers that are finite; otherwise fills `why`.
inline bool IsObservation(std::span<const float> observation, size_t size,
                          InvalidObservation* why) {
  *why = {.expected = size, .received = observation.size()};
  if (observation.size() != size) return false;
  for (size_t i = 0; i < size; ++i) {
    if (std::isfinite(observation[i])) continue;
    why->element = i;
    why->value = observation[i];
    return false;
  }
  return true;
}

}  // namespace spikeserve::robot
