// The answer to ListPolicies, which is made once for each catalog: reading the training records of
// a thousand versions takes milliseconds.
//
// Thread-safe.
#pragma once

#include <memory>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "server/policies/policy_catalog.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

class PolicyList {
 public:
  // Returns all policies of `catalog`.
  v1::ListPoliciesResponse Of(const std::shared_ptr<const PolicyCatalog>& catalog)
      ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  absl::Mutex mutex_;
  std::weak_ptr<const PolicyCatalog> catalog_ ABSL_GUARDED_BY(mutex_);  // that `list_` describes
  std::shared_ptr<const v1::ListPoliciesResponse> list_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
