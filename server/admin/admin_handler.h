// Answers the requests of PolicyAdmin: about policies and sessions (admin_handler.cc), their files
// (version_handler.cc), roll-outs, learned heads, holds, operators in a policy's place
// (seat_handler.cc) and usage. Independent of calls and connections.
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/open_sessions/session_store.h"
#include "server/admin/audit_log.h"
#include "server/agent/call_context.h"
#include "server/base/live_servers.h"
#include "server/base/shared_folder.h"
#include "server/policies/policy_registry.h"
#include "server/policies/shared_files.h"
#include "server/rollouts/rollout_manager.h"
#include "server/store/journal_store.h"
#include "server/usage/ledger.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

// Returns the request without the bytes of the file, for the audit log.
v1::PushPolicyRequest WithoutData(const v1::PushPolicyRequest& request);

class AdminHandler {
 public:
  // All must outlive the handler.
  struct Parts {
    PolicyRegistry* registry;
    SessionStore* store;
    const AuditLog* history;
    const LiveServers* replicas;
    const SharedFiles* files;      // of several servers; null: there is one
    const JournalStore* journals;  // null if no session is stored
    RolloutManager* rollouts;
    SharedFolder* folder;  // of the policies
    const Ledger* ledger;
    int64_t max_pushed;                     // versions of a policy
    std::function<void(bool)> on_draining;  // gets the new state, on the thread of the caller
  };

  explicit AdminHandler(Parts parts) : parts_(std::move(parts)) {}

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
  // Lists the actions of the tenants that the caller may read, and those of the server itself.
  absl::Status ListHistory(CallContext& context, const v1::ListHistoryRequest& request,
                           v1::ListHistoryResponse* response) const;
  // Lists the sessions that the caller may read; see Credential::CanRead.
  absl::Status ListSessions(CallContext& context, const v1::ListSessionsRequest& request,
                            v1::ListSessionsResponse* response) const;
  absl::Status Drain(CallContext& context, const v1::DrainRequest& request,
                     v1::DrainResponse* response) const;
  absl::Status GetUsage(CallContext& context, const v1::GetUsageRequest& request,
                        v1::GetUsageResponse* response) const;

  absl::Status PushPolicy(CallContext& context, const v1::PushPolicyRequest& request,
                          v1::PushPolicyResponse* response) const;
  absl::Status PullPolicy(CallContext& context, const v1::PullPolicyRequest& request,
                          v1::PullPolicyResponse* response) const;
  absl::Status RemovePolicy(CallContext& context, const v1::RemovePolicyRequest& request,
                            v1::RemovePolicyResponse* response) const;

  absl::Status StartRollout(CallContext& context, const v1::StartRolloutRequest& request,
                            v1::StartRolloutResponse* response) const;
  absl::Status AbortRollout(CallContext& context, const v1::AbortRolloutRequest& request,
                            v1::AbortRolloutResponse* response) const;
  absl::Status ListRollouts(CallContext& context, const v1::ListRolloutsRequest& request,
                            v1::ListRolloutsResponse* response) const;

  // A caller reaches the heads of the tenants whose sessions it may read; the others are
  // PERMISSION_DENIED. A head that several servers learn is first brought up to date with its log
  // (core/agent/head_log.h), so that all of them give the same answers. UNAVAILABLE if the log
  // cannot be reached, except that GetHead then answers with the head that this server has.
  absl::Status GetHead(CallContext& context, const v1::GetHeadRequest& request,
                       v1::GetHeadResponse* response) const;
  absl::Status PromoteHead(CallContext& context, const v1::PromoteHeadRequest& request,
                           v1::PromoteHeadResponse* response) const;
  absl::Status RollbackHead(CallContext& context, const v1::RollbackHeadRequest& request,
                            v1::RollbackHeadResponse* response) const;
  // Of a session of this server, or of such a head. FAILED_PRECONDITION if the head has forgotten
  // which of its updates are the operator's, and for sessions without a private head that learns.
  absl::Status UndoCorrections(CallContext& context, const v1::UndoCorrectionsRequest& request,
                               v1::UndoCorrectionsResponse* response) const;
  absl::Status PauseLearning(CallContext& context, const v1::PauseLearningRequest& request,
                             v1::PauseLearningResponse* response) const;
  absl::Status ResumeLearning(CallContext& context, const v1::ResumeLearningRequest& request,
                              v1::ResumeLearningResponse* response) const;

  absl::Status HoldSessions(CallContext& context, const v1::HoldSessionsRequest& request,
                            v1::HoldSessionsResponse* response) const;
  absl::Status ResumeSessions(CallContext& context, const v1::ResumeSessionsRequest& request,
                              v1::ResumeSessionsResponse* response) const;
  absl::Status ListHolds(CallContext& context, const v1::ListHoldsRequest& request,
                         v1::ListHoldsResponse* response) const;

  // The answer waits until the store has confirmed that this server has the session, so that nobody
  // steers a copy that no robot asks.
  absl::Status TakeControl(CallContext& context, const v1::TakeControlRequest& request,
                           v1::TakeControlResponse* response) const;
  absl::Status SteerSession(CallContext& context, const v1::SteerSessionRequest& request,
                            v1::SteerSessionResponse* response) const;
  absl::Status ReturnControl(CallContext& context, const v1::ReturnControlRequest& request,
                             v1::ReturnControlResponse* response) const;

 private:
  // Returns FAILED_PRECONDITION if a server that is alive lacks a version with a share.
  absl::Status CheckServedByAll(const std::string& policy,
                                const std::vector<TrafficShare>& shares) const;
  // Returns the tenant that a request means by `named`: empty, the caller's own. PERMISSION_DENIED
  // if the caller may not read it.
  static absl::StatusOr<std::string> TenantOf(const Credential& caller, const std::string& named);
  // Adds a version, in the share of `tenant` of the bytes in the folder, and fills in how that
  // changes the traffic. RESOURCE_EXHAUSTED if the share has no room for it; see
  // PolicyRegistry::AddVersion().
  absl::StatusOr<PolicyVersion> AddVersion(const std::string& tenant, const NewVersion& added,
                                           v1::TrafficChange* traffic) const;
  // Returns the pushed versions that make room for another one of the policy: the oldest that
  // neither settings nor open sessions use. RESOURCE_EXHAUSTED if these are too few.
  absl::StatusOr<std::vector<PolicyVersion>> Surplus(const std::string& policy) const;
  absl::Status Remove(const PolicyVersion& version, const std::string& tenant) const;
  // Fills in the last roll-out of `policy`.
  void Describe(const std::string& policy, v1::Rollout* rollout) const;
  absl::Status UndoOfSession(CallContext& context, const v1::UndoCorrectionsRequest& request,
                             v1::UndoCorrectionsResponse* response) const;
  // Pauses or resumes learning of a policy, or of all policies if `policy` is empty: in the
  // settings and in the logs of the heads.
  absl::Status SetPaused(const std::string& policy, bool paused) const;
  // Fills in the hold, with the number of sessions of this server that it covers.
  void Describe(const SessionHold& hold, const Credential& caller, v1::HeldSelection* proto) const;
  // Returns a session of this server that the caller may see. Does not reset its idle time, which
  // is the robot's.
  absl::StatusOr<std::shared_ptr<SessionEntry>> Find(const CallContext& context,
                                                     const std::string& id) const;

  const Parts parts_;
};

}  // namespace spikeserve
