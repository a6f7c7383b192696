// Computes only the new tokens of a decision. This is the engine that the server uses.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/engine/engine.h"

namespace spikeserve {

// Creates a streaming engine. The keys and values of earlier tokens never change, so they are kept
// as bits in a ring of N timesteps, which attention reads. A rate coder's neuron is one small
// integer, its period, and every weight row is read once per token instead of once per spike.
// REQUIRES: a valid policy of a spiking mode.
std::unique_ptr<Engine> MakeSpikingStreamingEngine(std::shared_ptr<const Policy> policy);

// Creates the same engine, which stores each number of the policy once: policy() lacks those that
// CompletePolicy() restores. Its weight matrices are in a file in `folder` that the processes of
// this user map; if `folder` is empty, in its own memory, and there is no error. Errors: see
// ShareBytes (shared_bytes.h). REQUIRES: a valid policy of a spiking mode.
absl::StatusOr<std::unique_ptr<Engine>> MakeCompactSpikingEngine(Policy policy,
                                                                 const std::string& folder);

// From now on, raises `largest`, which outlives the context, to the largest magnitude of the
// residual stream of every token of `context`. REQUIRES: a context of an engine of this file, not
// in integer arithmetic.
void RecordLargestResidual(Engine::Context& context, float* largest);

}  // namespace spikeserve
