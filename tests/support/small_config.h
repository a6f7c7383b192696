// The configuration of the small policies that tests play with.
#pragma once

#include "core/model/config.h"

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

}  // namespace spikeserve
