// A small random policy with the observations and actions of CartPole-v1.
#ifndef TESTS_SUPPORT_SMALL_POLICY_H_
#define TESTS_SUPPORT_SMALL_POLICY_H_

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

#endif  // TESTS_SUPPORT_SMALL_POLICY_H_
