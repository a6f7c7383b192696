// Answers PolicyAdmin's requests about what sessions learn: the heads that fleets share, and
// whether a policy learns at all.
//
// Thread-safe.
#ifndef SERVER_ADMIN_HEAD_HANDLER_H_
#define SERVER_ADMIN_HEAD_HANDLER_H_

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "core/session/session_store.h"
#include "server/policies/policy_registry.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class HeadHandler {
 public:
  // Both must outlive this object.
  HeadHandler(PolicyRegistry* registry, SessionStore* store) : registry_(registry), store_(store) {}

  // Each fills in `response` and returns OK, or returns the error that policy_admin.proto names and
  // changes nothing. NOT_FOUND for a policy or version that is not served.
  absl::Status GetHead(const v1::GetHeadRequest& request, v1::GetHeadResponse* response) const;
  absl::Status PromoteHead(const v1::PromoteHeadRequest& request,
                           v1::PromoteHeadResponse* response) const;
  absl::Status RollbackHead(const v1::RollbackHeadRequest& request,
                            v1::RollbackHeadResponse* response) const;
  absl::Status PauseLearning(const v1::PauseLearningRequest& request,
                             v1::PauseLearningResponse* response) const;
  absl::Status ResumeLearning(const v1::ResumeLearningRequest& request,
                              v1::ResumeLearningResponse* response) const;

 private:
  PolicyRegistry* const registry_;
  SessionStore* const store_;
  mutable absl::Mutex promote_mutex_;  // so that two promotions never pick one version number
};

}  // namespace spikeserve

#endif  // SERVER_ADMIN_HEAD_HANDLER_H_
