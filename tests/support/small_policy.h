// A small random policy with the observations and actions of CartPole-v1.
#pragma once

#include <cstdint>

#include "core/model/policy.h"
#include "tests/support/small_config.h"

namespace spikeserve {

// Returns a random policy for observations of length 4 and, unless another space is given, two
// actions.
inline Policy SmallPolicy(const ModelConfig& config = SmallConfig(),
                          const ActionSpace& action_space = ActionSpace::Discrete(2),
                          uint64_t seed = 1) {
  return RandomPolicy(config, /*observation_size=*/4, action_space, seed);
}

}  // namespace spikeserve
