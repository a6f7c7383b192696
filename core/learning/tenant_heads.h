// The shared heads of one policy version, one for each tenant. The empty name is that of the
// sessions without a tenant.
//
// Thread-safe.
#pragma once

#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "core/learning/fleet_head.h"
#include "core/model/policy.h"

namespace spikeserve {

class TenantHeads {
 public:
  explicit TenantHeads(std::shared_ptr<const Policy> policy) : policy_(std::move(policy)) {}

  // Returns the head of a tenant. Creates it if the tenant has none. To be called for known tenants
  // only, because the heads stay.
  std::shared_ptr<FleetHead> Of(const std::string& tenant) {
    absl::MutexLock lock(&mutex_);
    std::shared_ptr<FleetHead>& head = heads_[tenant];
    if (head == nullptr) head = std::make_shared<FleetHead>(policy_);
    return head;
  }

  const std::shared_ptr<const Policy>& policy() const { return policy_; }

  // Returns all tenants with a head, sorted.
  std::vector<std::string> Tenants() const {
    absl::MutexLock lock(&mutex_);
    std::vector<std::string> tenants;
    for (const auto& [tenant, head] : heads_) tenants.push_back(tenant);
    return tenants;
  }

  // Returns the head of a tenant, or null if it has none.
  std::shared_ptr<FleetHead> Find(const std::string& tenant) const {
    absl::MutexLock lock(&mutex_);
    const auto found = heads_.find(tenant);
    return found == heads_.end() ? nullptr : found->second;
  }

 private:
  const std::shared_ptr<const Policy> policy_;
  mutable absl::Mutex mutex_;
  std::map<std::string, std::shared_ptr<FleetHead>> heads_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
