#include "client/src/pilot/sight.h"

#include <cmath>

#include "absl/strings/str_cat.h"

namespace spikeserve::piloting {

std::string Blindness::ToString() const {
  if (received != expected) {
    return absl::StrCat("observation: expected ", expected, " numbers, received ", received);
  }
  return absl::StrCat("observation[", element, "]: expected a finite number, received ", value);
}

bool IsObservation(absl::Span<const float> observation, size_t size, Blindness* why) {
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

}  // namespace spikeserve::piloting
