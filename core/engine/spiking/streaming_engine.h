// The engine that serves: computes only a decision's new tokens.
#ifndef CORE_ENGINE_SPIKING_STREAMING_ENGINE_H_
#define CORE_ENGINE_SPIKING_STREAMING_ENGINE_H_

#include <memory>

#include "core/engine/engine.h"

namespace spikeserve {

// Earlier tokens live on as bits: a token's keys and values never change, so attention over the
// band reads them from a ring of N timesteps. A rate coder's neuron is one small integer (its
// period), and every weight row is read once per token, not once per spike. REQUIRES: a valid
// policy of a spiking mode.
std::unique_ptr<Engine> MakeSpikingStreamingEngine(std::shared_ptr<const Policy> policy);

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_STREAMING_ENGINE_H_
