// Answers the requests of PolicyAdmin that hold sessions. Independent of calls and connections.
//
// Thread-safe.
#pragma once

#include "absl/status/status.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/call_context.h"
#include "server/policies/policy_registry.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class HoldHandler {
 public:
  // Both must outlive the handler.
  HoldHandler(PolicyRegistry* registry, SessionStore* store) : registry_(registry), store_(store) {}

  // Each method fills in `response` and returns OK. On an error it changes nothing and returns the
  // status that policy_admin.proto names.
  absl::Status HoldSessions(CallContext& context, const v1::HoldSessionsRequest& request,
                            v1::HoldSessionsResponse* response) const;
  absl::Status ResumeSessions(CallContext& context, const v1::ResumeSessionsRequest& request,
                              v1::ResumeSessionsResponse* response) const;
  absl::Status ListHolds(CallContext& context, const v1::ListHoldsRequest& request,
                         v1::ListHoldsResponse* response) const;

 private:
  // Fills in the hold, with the number of sessions of this server that it covers.
  void ToProto(const SessionHold& hold, const Credential& caller, v1::HeldSelection* proto) const;

  PolicyRegistry* const registry_;
  SessionStore* const store_;
};

}  // namespace spikeserve
