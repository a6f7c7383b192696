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
  return std::max(2, config.layers * (config.context - 1) + 1) +
         (config.observation_changes ? 1 : 0);
}

}  // namespace spikeserve
