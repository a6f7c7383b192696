// The streaming engine of policies in integer arithmetic (docs/design/integer.md).
#ifndef CORE_ENGINE_SPIKING_INTEGER_ENGINE_H_
#define CORE_ENGINE_SPIKING_INTEGER_ENGINE_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/engine/engine.h"

namespace spikeserve {

// Create a streaming engine, as the functions of streaming_engine.h do. Populations are updated
// only at ticks with an input spike, and attention rows are computed only for heads whose query
// fires. REQUIRE: a valid policy with Arithmetic::kInteger.
std::unique_ptr<Engine> MakeIntegerStreamingEngine(std::shared_ptr<const Policy> policy);
std::unique_ptr<Engine> MakeCompactIntegerEngine(Policy policy);
absl::StatusOr<std::unique_ptr<Engine>> MakeSharedIntegerEngine(Policy policy,
                                                                const std::string& folder);

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_INTEGER_ENGINE_H_
