// Tells an observation from what a robot passes in its place. Allocates no memory for it, so that
// a beat can.
//
// Not thread-safe.
#ifndef CLIENT_SRC_PILOT_SIGHT_H_
#define CLIENT_SRC_PILOT_SIGHT_H_

#include <cstddef>
#include <string>

#include "absl/types/span.h"

namespace spikeserve::piloting {

// Why an observation is not valid.
struct Blindness {
  size_t expected = 0;  // numbers
  size_t received = 0;
  size_t element = 0;  // of the first number that is not finite, if the size is right
  float value = 0.0f;

  // Returns "field: expected X, received Y".
  std::string ToString() const;
};

// Returns whether `observation` has `size` numbers that are finite; otherwise fills `why`.
bool IsObservation(absl::Span<const float> observation, size_t size, Blindness* why);

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_SIGHT_H_
