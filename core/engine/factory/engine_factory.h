// Creates the engine that fits a policy's mode, and recomputes decisions to explain them.
//
// All functions are thread-safe.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/engine/engine.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

// Creates an engine that evaluates the equations in naive loops and recomputes the whole episode at
// every decision. Its results define the bits that every other engine must produce. For tests.
// REQUIRES: a valid policy.
std::unique_ptr<Engine> MakeReferenceEngine(std::shared_ptr<const Policy> policy);

// Creates the engine that decides everywhere else: it serves, plays and evaluates. It stores the
// keys and values of earlier tokens, bit-packed in spiking modes, and computes only the new tokens.
// REQUIRES: a valid policy.
std::unique_ptr<Engine> MakeEngine(std::shared_ptr<const Policy> policy);

// Creates the same engine, which stores each number of the policy once and not a second time for
// policy() (see Engine::CompletePolicy). REQUIRES: a valid policy.
std::unique_ptr<Engine> MakeEngine(Policy policy);

// As above, but the weight matrices are once in memory for all processes of this user that name the
// same folder. Decisions are equal bit for bit. Errors: see ShareBytes (shared_bytes.h);
// INVALID_ARGUMENT for a dense policy. REQUIRES: a valid policy.
absl::StatusOr<std::unique_ptr<Engine>> MakeEngine(Policy policy, const std::string& folder);

// Recomputes the decision at the last token of `prefix`, a state token, with the reference engine
// of the policy's mode. Writes the result into `output` and the recording into `trace`. `prefix`
// holds the last HistorySize() timesteps, or the whole episode if it is shorter. Thread-safe.
void TraceDecision(const Policy& policy, const PrefixContext& prefix, Engine::Output* output,
                   Trace* trace);

}  // namespace spikeserve
