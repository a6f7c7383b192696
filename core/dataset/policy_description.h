// Adds to a policy what recorded episodes say about the robot: the names of its elements, and a
// model of its observations, by which the wiring of sessions is checked.
//
// Thread-safe on distinct policies.
#pragma once

#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/dataset/dataset.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Sets the names of the elements to `observation_names` and `action_names` of a dataset's recipe,
// as conversions write them. Leaves what the policy has; ignores names that do not fit it.
void AddNames(const nlohmann::json& recipe, Policy* policy);

// Returns INVALID_ARGUMENT, which names the first difference, if a dataset's recipe and the policy
// both name the elements, and do so differently or in another order.
absl::Status CheckRecordedNames(const nlohmann::json& recipe, const Policy& policy);

// Fits policy->wiring to the episodes. FAILED_PRECONDITION if the observations are too long or the
// episodes too short (WiringFit::Finish). REQUIRES: the episodes have the policy's spaces.
absl::Status AddWiringModel(absl::Span<const Episode> episodes, Policy* policy);

}  // namespace spikeserve
