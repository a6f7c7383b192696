#include "core/engine/factory/engine_factory.h"

#include <utility>

#include "absl/status/status.h"
#include "core/base/status.h"
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
  if (!policy.config.is_dense()) return *MakeCompactSpikingEngine(std::move(policy), /*folder=*/"");
  return MakeDenseStreamingEngine(std::make_shared<const Policy>(std::move(policy)));
}

absl::StatusOr<std::unique_ptr<Engine>> MakeEngine(Policy policy, const std::string& folder) {
  if (policy.config.is_dense()) {
    return InvalidArgument("mode", "a spiking policy", "dense");
  }
  return MakeCompactSpikingEngine(std::move(policy), folder);
}

void TraceDecision(const Policy& policy, const PrefixContext& prefix, Engine::Output* output,
                   Trace* trace) {
  *trace = Trace();
  trace->layers.resize(static_cast<size_t>(policy.config.layers));
  if (policy.config.is_dense()) {
    ComputeDenseReference(policy, prefix, output, trace);
  } else {
    ComputeSpikingReference(policy, prefix, output, trace);
  }
}

}  // namespace spikeserve
