// Shows how the traffic of a policy is divided, and how a call has changed it.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <string>

#include "nlohmann/json.hpp"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

// Returns two lines with the whole traffic before and after a change, each preceded by a newline.
std::string ToText(const v1::TrafficChange& change);

// Adds the members "before" and "after" to `json`.
void AddTraffic(const v1::TrafficChange& change, nlohmann::ordered_json* json);

}  // namespace spikeserve
