// Answers the requests of PolicyAdmin about learning: reads, promotes and rolls back the heads that
// fleets share, and pauses and resumes learning. A head that several servers learn is first brought
// up to date with its log (core/agent/head_log.h), so that all of them give the same answers.
//
// Thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/call_context.h"
#include "server/base/shared_folder.h"
#include "server/policies/policy_registry.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class HeadHandler {
 public:
  // All must outlive this object. `folder` is that of the policies.
  HeadHandler(PolicyRegistry* registry, SessionStore* store, SharedFolder* folder)
      : registry_(registry), store_(store), folder_(folder) {}

  // Each method fills in `response` and returns OK. On an error it changes nothing and returns the
  // status that policy_admin.proto names; NOT_FOUND if the policy or version is not served, and
  // UNAVAILABLE if the log of the head cannot be reached, except that GetHead then answers with the
  // head that this server has. A caller reaches the heads of the tenants whose sessions it may
  // read; the others are PERMISSION_DENIED.
  absl::Status GetHead(CallContext& context, const v1::GetHeadRequest& request,
                       v1::GetHeadResponse* response) const;
  absl::Status PromoteHead(CallContext& context, const v1::PromoteHeadRequest& request,
                           v1::PromoteHeadResponse* response) const;
  absl::Status RollbackHead(CallContext& context, const v1::RollbackHeadRequest& request,
                            v1::RollbackHeadResponse* response) const;
  absl::Status PauseLearning(CallContext& context, const v1::PauseLearningRequest& request,
                             v1::PauseLearningResponse* response) const;
  absl::Status ResumeLearning(CallContext& context, const v1::ResumeLearningRequest& request,
                              v1::ResumeLearningResponse* response) const;

 private:
  // Pauses or resumes learning of a policy, or of all policies if `policy` is empty: in the
  // settings and in the logs of the heads.
  absl::Status SetPaused(const std::string& policy, bool paused) const;

  PolicyRegistry* const registry_;
  SessionStore* const store_;
  SharedFolder* const folder_;
};

}  // namespace spikeserve
