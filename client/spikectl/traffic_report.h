// Shows how the traffic of a policy is divided, and how a call has changed it.
//
// A pure function; safe to call from many threads.
#pragma once

#include <string>

#include "client/spikectl/admin_call.h"
#include "nlohmann/json.hpp"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

// Returns the answer of a call that has changed `traffic`: `text` and `json`, and the whole traffic
// before and after it, as two lines and as the members "before" and "after".
ServerAnswer TrafficAnswer(std::string text, nlohmann::ordered_json json,
                           const v1::TrafficChange& traffic);

}  // namespace spikeserve
