#include "core/engine/engine.h"

#include <algorithm>

#include "core/engine/dense_engine.h"
#include "core/engine/reference_engine.h"
#include "core/engine/streaming_engine.h"

namespace spikeserve {

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
