#include "core/engine/factory/trace_decision.h"

#include "core/engine/dense/dense_engine.h"
#include "core/engine/reference/reference_engine.h"

namespace spikeserve {

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
