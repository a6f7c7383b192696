// Answers the requests of PolicyAdmin. Knows messages, policies and sessions, but no calls or
// connections.
//
// Thread-safe.
#ifndef SERVER_ADMIN_ADMIN_HANDLER_H_
#define SERVER_ADMIN_ADMIN_HANDLER_H_

#include <functional>
#include <utility>

#include "absl/status/status.h"
#include "core/session/session_store.h"
#include "server/access/authenticator.h"
#include "server/policies/policy_registry.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class AdminHandler {
 public:
  // Both must outlive the handler. `on_draining` hears what Drain has set, from its caller's
  // thread.
  AdminHandler(PolicyRegistry* registry, SessionStore* store, std::function<void(bool)> on_draining)
      : registry_(registry), store_(store), on_draining_(std::move(on_draining)) {}

  // Each fills in `response` and returns OK, or returns the error that policy_admin.proto names and
  // changes nothing.
  absl::Status LoadPolicy(const v1::LoadPolicyRequest& request,
                          v1::LoadPolicyResponse* response) const;
  absl::Status UnloadPolicy(const v1::UnloadPolicyRequest& request,
                            v1::UnloadPolicyResponse* response) const;
  absl::Status ReloadPolicies(const v1::ReloadPoliciesRequest& request,
                              v1::ReloadPoliciesResponse* response) const;
  absl::Status SetDefaultVersion(const v1::SetDefaultVersionRequest& request,
                                 v1::SetDefaultVersionResponse* response) const;
  absl::Status SetLabel(const v1::SetLabelRequest& request, v1::SetLabelResponse* response) const;
  absl::Status RemoveLabel(const v1::RemoveLabelRequest& request,
                           v1::RemoveLabelResponse* response) const;
  absl::Status SetTraffic(const v1::SetTrafficRequest& request,
                          v1::SetTrafficResponse* response) const;
  // Of the sessions that `caller` may see.
  absl::Status ListSessions(const Credential& caller, const v1::ListSessionsRequest& request,
                            v1::ListSessionsResponse* response) const;
  absl::Status Drain(const v1::DrainRequest& request, v1::DrainResponse* response) const;

 private:
  PolicyRegistry* const registry_;
  SessionStore* const store_;
  const std::function<void(bool)> on_draining_;
};

}  // namespace spikeserve

#endif  // SERVER_ADMIN_ADMIN_HANDLER_H_
