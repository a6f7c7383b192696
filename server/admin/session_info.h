// One line of a list of sessions.
#ifndef SERVER_ADMIN_SESSION_INFO_H_
#define SERVER_ADMIN_SESSION_INFO_H_

#include "core/session/session_store.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

// Holds the session's lock for a moment. Thread-safe.
void ToProto(const ListedSession& listed, v1::SessionInfo* info);

}  // namespace spikeserve

#endif  // SERVER_ADMIN_SESSION_INFO_H_
