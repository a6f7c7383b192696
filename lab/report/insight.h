// The spikes and gates of one episode of a trained policy, for the report's figures.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/status/statusor.h"
#include "core/model/policy.h"

namespace spikeserve {

struct Insight {
  std::vector<int64_t> spikes;  // [decisions], total spikes of each decision
  // [H][tokens], oldest token first: the first layer's routing gates over the window of the last
  // decision, as means over ticks (eq. 4.10). Empty without routing.
  std::vector<std::vector<double>> gates;
};

// Plays one episode greedily from Environment::Reset(seed). Returns the errors of Evaluate.
// Thread-safe.
absl::StatusOr<Insight> LookInside(std::shared_ptr<const Policy> policy, uint64_t seed);

}  // namespace spikeserve
