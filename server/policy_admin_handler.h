// Answers the requests of PolicyAdmin. Knows messages, policies and sessions, but no calls or
// connections.
//
// Thread-safe.
#ifndef SERVER_POLICY_ADMIN_HANDLER_H_
#define SERVER_POLICY_ADMIN_HANDLER_H_

#include "absl/status/status.h"
#include "core/session/session_store.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class PolicyAdminHandler {
 public:
  // `store` must outlive the handler.
  explicit PolicyAdminHandler(SessionStore* store) : store_(store) {}

  // Each fills in `response` and returns OK, or returns the error that policy_admin.proto names and
  // changes nothing.
  absl::Status ListSessions(const v1::ListSessionsRequest& request,
                            v1::ListSessionsResponse* response) const;

 private:
  SessionStore* const store_;
};

}  // namespace spikeserve

#endif  // SERVER_POLICY_ADMIN_HANDLER_H_
