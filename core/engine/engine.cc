#include "core/engine/engine.h"

#include "core/engine/dense_engine.h"
#include "core/engine/reference_engine.h"
#include "core/engine/streaming_engine.h"

namespace spikeserve {

int HistorySize(const ModelConfig& config) { return config.layers * (config.context - 1) + 1; }

std::unique_ptr<Engine> MakeReferenceEngine(std::shared_ptr<const Policy> policy) {
  if (policy->config.is_dense()) return std::make_unique<DenseReferenceEngine>(std::move(policy));
  return std::make_unique<ReferenceEngine>(std::move(policy));
}

std::unique_ptr<Engine> MakeStreamingEngine(std::shared_ptr<const Policy> policy) {
  if (policy->config.is_dense()) return std::make_unique<DenseStreamingEngine>(std::move(policy));
  return std::make_unique<StreamingEngine>(std::move(policy));
}

}  // namespace spikeserve
