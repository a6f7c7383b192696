// Converts listed sessions to messages.
#pragma once

#include "core/open_sessions/session_store.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

// Fills in `info`. Holds the session's lock only while it copies the values. Thread-safe.
void ToProto(const ListedSession& listed, v1::SessionInfo* info);

}  // namespace spikeserve
