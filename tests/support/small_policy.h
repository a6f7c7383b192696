// The small random policies that tests play with.
#pragma once

#include <cstdint>

#include "core/model/policy.h"

namespace spikeserve {

// Returns a configuration with two layers and a window of 4 timesteps, so that a decision depends
// on 7 timesteps.
inline ModelConfig SmallConfig(Mode mode = Mode::kFull) {
  ModelConfig config;
  config.mode = mode;
  config.hidden_size = 16;
  config.heads = 2;
  config.layers = 2;
  config.ticks = 5;
  config.context = 4;
  config.routing_hidden_size = 4;
  config.ffn_size = 32;
  return config;
}

// Returns a random policy for observations of length 4 and, unless another space is given, two
// actions.
inline Policy SmallPolicy(const ModelConfig& config = SmallConfig(),
                          const ActionSpace& action_space = ActionSpace::Discrete(2),
                          uint64_t seed = 1) {
  return RandomPolicy(config, /*observation_size=*/4, action_space, seed);
}

}  // namespace spikeserve
