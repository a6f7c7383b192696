#include "core/engine/engine.h"

#include <algorithm>

#include "core/engine/dense/dense_engine.h"
#include "core/engine/reference/reference_engine.h"
#include "core/engine/spiking/streaming_engine.h"

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
  return std::max(2, config.layers * (config.context - 1) + 1);
}

std::unique_ptr<Engine> MakeReferenceEngine(std::shared_ptr<const Policy> policy) {
  return policy->config.is_dense() ? MakeDenseReferenceEngine(std::move(policy))
                                   : MakeSpikingReferenceEngine(std::move(policy));
}

std::unique_ptr<Engine> MakeStreamingEngine(std::shared_ptr<const Policy> policy) {
  return policy->config.is_dense() ? MakeDenseStreamingEngine(std::move(policy))
                                   : MakeSpikingStreamingEngine(std::move(policy));
}

}  // namespace spikeserve
