// Checks that a response holds no NaN and no infinity: the last check before it is sent. Decisions
// are not checked here, because AgentSession checks them before they change the session.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <google/protobuf/message.h>

#include <string>

#include "absl/status/status.h"

namespace spikeserve {

// Returns INTERNAL, which names the field and `policy`, unless every number of `response`, at all
// levels, is finite. `policy` may be empty.
absl::Status CheckFinite(const google::protobuf::Message& response, const std::string& policy);

// Returns the text of the field `name` of a message; empty if it has no such field.
std::string TextOf(const google::protobuf::Message& message, const std::string& name);

}  // namespace spikeserve
