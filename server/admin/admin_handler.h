// Answers the requests of PolicyAdmin about policies and sessions; HeadHandler answers those about
// learning. Independent of calls and connections, so that it can be tested without a network.
//
// Thread-safe.
#pragma once

#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "core/open_sessions/session_store.h"
#include "server/admin/audit_log.h"
#include "server/agent/call_context.h"
#include "server/base/replicas.h"
#include "server/policies/policy_registry.h"
#include "server/policies/shared_files.h"
#include "server/store/journal_store.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class AdminHandler {
 public:
  // All must outlive the handler. `files` compares those of several servers; null: there is one.
  // `journals` is null if no session is stored.
  // Drain calls `on_draining` with the new draining state, on the
  // thread of its caller.
  AdminHandler(PolicyRegistry* registry, SessionStore* store, const AuditLog* history,
               const Replicas* replicas, const SharedFiles* files, const JournalStore* journals,
               std::function<void(bool)> on_draining)
      : registry_(registry),
        store_(store),
        history_(history),
        replicas_(replicas),
        files_(files),
        journals_(journals),
        on_draining_(std::move(on_draining)) {}

  // Each method fills in `response` and returns OK. On an error it changes nothing and returns the
  // status that policy_admin.proto names.
  absl::Status LoadPolicy(CallContext& context, const v1::LoadPolicyRequest& request,
                          v1::LoadPolicyResponse* response) const;
  absl::Status UnloadPolicy(CallContext& context, const v1::UnloadPolicyRequest& request,
                            v1::UnloadPolicyResponse* response) const;
  absl::Status ReloadPolicies(CallContext& context, const v1::ReloadPoliciesRequest& request,
                              v1::ReloadPoliciesResponse* response) const;
  absl::Status SetDefaultVersion(CallContext& context, const v1::SetDefaultVersionRequest& request,
                                 v1::SetDefaultVersionResponse* response) const;
  absl::Status SetLabel(CallContext& context, const v1::SetLabelRequest& request,
                        v1::SetLabelResponse* response) const;
  absl::Status RemoveLabel(CallContext& context, const v1::RemoveLabelRequest& request,
                           v1::RemoveLabelResponse* response) const;
  absl::Status SetTraffic(CallContext& context, const v1::SetTrafficRequest& request,
                          v1::SetTrafficResponse* response) const;
  absl::Status SetTrafficShares(CallContext& context, const v1::SetTrafficSharesRequest& request,
                                v1::SetTrafficSharesResponse* response) const;
  absl::Status SetShadow(CallContext& context, const v1::SetShadowRequest& request,
                         v1::SetShadowResponse* response) const;
  // Lists the actions of the tenants that `caller` may read, and those of the server itself.
  absl::Status ListHistory(CallContext& context, const v1::ListHistoryRequest& request,
                           v1::ListHistoryResponse* response) const;
  // Lists the sessions that `caller` may read; see Credential::CanRead.
  absl::Status ListSessions(CallContext& context, const v1::ListSessionsRequest& request,
                            v1::ListSessionsResponse* response) const;
  absl::Status Drain(CallContext& context, const v1::DrainRequest& request,
                     v1::DrainResponse* response) const;

 private:
  // Returns FAILED_PRECONDITION if a server that is alive lacks a version with a share.
  absl::Status CheckServedByAll(const std::string& policy,
                                const std::vector<TrafficShare>& shares) const;

  PolicyRegistry* const registry_;
  SessionStore* const store_;
  const AuditLog* const history_;
  const Replicas* const replicas_;
  const SharedFiles* const files_;
  const JournalStore* const journals_;
  const std::function<void(bool)> on_draining_;
};

}  // namespace spikeserve
