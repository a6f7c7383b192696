#include "core/robot/observation.h"

#include <cmath>

namespace spikeserve::robot {

std::string InvalidObservation::ToString() const {
  if (received != expected) {
    return "observation: expected " + std::to_string(expected) + " numbers, received " +
           std::to_string(received);
  }
  const char* const number = std::isnan(value) ? "nan" : value < 0.0f ? "-inf" : "inf";
  return "observation[" + std::to_string(element) + "]: expected a finite number, received " +
         number;
}

bool IsObservation(std::span<const float> observation, size_t size, InvalidObservation* why) {
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
