// The streaming engine of policies in integer arithmetic (docs/design/integer.md).
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/engine/engine.h"

namespace spikeserve {

// Create a streaming engine, as the functions of streaming_engine.h do. Populations are updated
// only at ticks with an input spike, and attention rows are computed only for heads whose query
// fires. REQUIRE: a valid policy with Arithmetic::kInteger.
std::unique_ptr<Engine> MakeIntegerStreamingEngine(std::shared_ptr<const Policy> policy);
absl::StatusOr<std::unique_ptr<Engine>> MakeCompactIntegerEngine(Policy policy,
                                                                 const std::string& folder);

// The spikes of each hidden neuron: [L][F].
using HiddenSpikes = std::vector<std::vector<uint64_t>>;

// From now on, adds the hidden neurons' spikes for every token of `context` to `spikes`, which has
// the shape [L][F] and outlives the context. REQUIRES: a context of an engine of this file.
void RecordHiddenSpikes(Engine::Context& context, HiddenSpikes* spikes);

}  // namespace spikeserve
