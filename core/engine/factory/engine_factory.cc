#include "core/engine/factory/engine_factory.h"

#include <utility>

#include "absl/status/status.h"
#include "core/engine/dense/dense_engine.h"
#include "core/engine/reference/reference_engine.h"
#include "core/engine/spiking/streaming_engine.h"

namespace spikeserve {

std::unique_ptr<Engine> MakeReferenceEngine(std::shared_ptr<const Policy> policy) {
  return policy->config.is_dense() ? MakeDenseReferenceEngine(std::move(policy))
                                   : MakeSpikingReferenceEngine(std::move(policy));
}

std::unique_ptr<Engine> MakeEngine(std::shared_ptr<const Policy> policy) {
  return policy->config.is_dense() ? MakeDenseStreamingEngine(std::move(policy))
                                   : MakeSpikingStreamingEngine(std::move(policy));
}

std::unique_ptr<Engine> MakeEngine(Policy policy) {
  if (!policy.config.is_dense()) return MakeCompactSpikingEngine(std::move(policy));
  return MakeDenseStreamingEngine(std::make_shared<const Policy>(std::move(policy)));
}

absl::StatusOr<std::unique_ptr<Engine>> MakeEngine(Policy policy, const std::string& folder) {
  if (policy.config.is_dense()) {
    return absl::InvalidArgumentError("mode: expected a spiking policy, received dense");
  }
  return MakeSharedSpikingEngine(std::move(policy), folder);
}

}  // namespace spikeserve
