// Answers the requests of PolicyAdmin by which operators act in the place of policies. Independent
// of calls and connections.
//
// Thread-safe.
#pragma once

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/call_context.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class SeatHandler {
 public:
  // `store` must outlive the handler.
  explicit SeatHandler(SessionStore* store) : store_(store) {}

  // Each method fills in `response` and returns OK. On an error it changes nothing and returns the
  // status that policy_admin.proto names. The answer waits until the store has confirmed that this
  // server has the session, so that nobody steers a copy that no robot asks.
  absl::Status TakeControl(CallContext& context, const v1::TakeControlRequest& request,
                           v1::TakeControlResponse* response) const;
  absl::Status SteerSession(CallContext& context, const v1::SteerSessionRequest& request,
                            v1::SteerSessionResponse* response) const;
  absl::Status ReturnControl(CallContext& context, const v1::ReturnControlRequest& request,
                             v1::ReturnControlResponse* response) const;

 private:
  // Returns a session of this server that the caller may see. Does not reset its idle time, which
  // is the robot's.
  absl::StatusOr<std::shared_ptr<SessionEntry>> Find(const CallContext& context,
                                                     const std::string& id) const;

  SessionStore* const store_;
};

}  // namespace spikeserve
