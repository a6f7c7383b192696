// The scaling of returns and the default target return of each environment.
#pragma once

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// The input of the return token is (G - offset) / scale. `target` is the return that a policy is
// conditioned on by default. All three are in environment units.
struct ReturnScaling {
  float offset;
  float scale;
  float target;
};

// Returns NOT_FOUND, with the known environments, if `id` is unknown.
absl::StatusOr<ReturnScaling> ReturnScalingOf(absl::string_view id);

}  // namespace spikeserve
