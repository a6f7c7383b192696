// Creates the engine that fits a policy's mode.
//
// All functions are thread-safe.
#ifndef CORE_ENGINE_FACTORY_ENGINE_FACTORY_H_
#define CORE_ENGINE_FACTORY_ENGINE_FACTORY_H_

#include <memory>

#include "core/engine/engine.h"

namespace spikeserve {

// Creates an engine that evaluates the equations in naive loops and recomputes the whole episode at
// every decision. Its results define the bits that every other engine must produce. For tests.
// REQUIRES: a valid policy.
std::unique_ptr<Engine> MakeReferenceEngine(std::shared_ptr<const Policy> policy);

// Creates the engine that the server uses. It stores the keys and values of earlier tokens,
// bit-packed in spiking modes, and computes only the new tokens. REQUIRES: a valid policy.
std::unique_ptr<Engine> MakeStreamingEngine(std::shared_ptr<const Policy> policy);

}  // namespace spikeserve

#endif  // CORE_ENGINE_FACTORY_ENGINE_FACTORY_H_
