// Makes an engine for any policy, whatever its mode.
//
// Free functions, safe to call from many threads.
#ifndef CORE_ENGINE_FACTORY_ENGINE_FACTORY_H_
#define CORE_ENGINE_FACTORY_ENGINE_FACTORY_H_

#include <memory>

#include "core/engine/engine.h"

namespace spikeserve {

// The equations as naive loops that recompute the whole episode at every decision: the definition
// of what every other engine must equal bit for bit. For tests. `policy` must be valid.
std::unique_ptr<Engine> MakeReferenceEngine(std::shared_ptr<const Policy> policy);

// Computes only the new tokens, on bit-packed keys and values: the engine that serves. `policy`
// must be valid.
std::unique_ptr<Engine> MakeStreamingEngine(std::shared_ptr<const Policy> policy);

}  // namespace spikeserve

#endif  // CORE_ENGINE_FACTORY_ENGINE_FACTORY_H_
