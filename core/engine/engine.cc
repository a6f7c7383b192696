#include "core/engine/engine.h"

#include <algorithm>

#include "core/contract/dcheck.h"

namespace spikeserve {

void Engine::DecideTogether(absl::Span<const Decision> decisions) const {
  for (const Decision& d : decisions) {
    Decide(*d.context, d.return_to_go, d.observation, d.output);
  }
}

void Engine::AppendActionsTogether(absl::Span<const TakenAction> actions) const {
  for (const TakenAction& action : actions) AppendAction(*action.context, action.encoded_action);
}

int HistorySize(const ModelConfig& config) {
  SPIKESERVE_DCHECK(config.layers >= 1 && config.context >= 1);
  const int before = config.context - 1;
  int needed = config.layers * before + 1;
  if (config.carries_membranes()) {
    // The readout, and each layer's input, need the timesteps since the start of a block. A layer
    // then looks back N - 1 timesteps from there, which is the start of a block itself.
    const int block = config.membrane_block;
    needed = block + config.layers * block * ((before + block - 1) / block);
  }
  return std::max(2, needed) + (config.observation_changes ? 1 : 0);
}

}  // namespace spikeserve
