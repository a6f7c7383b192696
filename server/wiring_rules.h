// Parses --wiring: what follows from verdicts about the wiring of sessions.
#pragma once

#include <map>
#include <string>

#include "absl/status/statusor.h"
#include "core/agent/wiring_check.h"

namespace spikeserve {

// The response of each policy; that of the policy "" is the one of all others.
using WiringRules = std::map<std::string, WiringResponse>;

// Parses "count", "warn" or "safe", and POLICY=RESPONSE for single policies, by commas: for example
// "warn,arm=safe". INVALID_ARGUMENT for anything else. Thread-safe.
absl::StatusOr<WiringRules> ParseWiringRules(const std::string& text);

}  // namespace spikeserve
