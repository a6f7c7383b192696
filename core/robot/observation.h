// Tells an observation from what a robot passes in its place. Allocates no memory for it, so that
// a control step can.
//
// Free functions, safe to call from many threads.
#pragma once

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
  std::string ToString() const;
};

// Returns whether `observation` has `size` numbers that are finite; otherwise fills `why`.
bool IsObservation(std::span<const float> observation, size_t size, InvalidObservation* why);

}  // namespace spikeserve::robot
