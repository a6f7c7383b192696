// Formats the explanation of a decision for `spikectl explain`.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Returns a text with the inputs and outputs of the decision, a raster of each population that
// fired (one row of cells per neuron that fired, one column per tick), the routing gates of the
// state token, and the keys with the largest attention weights of each head. `policy` has the names
// of the elements, and may be empty. INVALID_ARGUMENT, which names the field, if a number of the
// answer is no index or size.
absl::StatusOr<std::string> ExplainToText(const v1::ExplainResponse& explained,
                                          const v1::PolicyInfo& policy);

}  // namespace spikeserve
