// Checks that a response holds no NaN and no infinity: the last check before it is sent. Decisions
// are not checked here, because AgentSession checks them before they change the session.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <google/protobuf/message.h>

#include <string>
#include <type_traits>

#include "absl/status/status.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// True for responses whose numbers AgentSession has checked.
template <typename Response>
inline constexpr bool kHoldsDecisions =
    std::is_same_v<Response, v1::ActResponse> || std::is_same_v<Response, v1::ActBatchResponse>;

// Returns INTERNAL, which names the field and `policy`, unless every number of `response`, at all
// levels, is finite. `policy` may be empty.
absl::Status CheckFinite(const google::protobuf::Message& response, const std::string& policy);

// Returns the field `policy` of a message; empty if it has none.
std::string PolicyOf(const google::protobuf::Message& message);

}  // namespace spikeserve
