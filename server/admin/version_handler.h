// Answers the requests of PolicyAdmin that move the files of versions: PushPolicy, PullPolicy and
// RemovePolicy.
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/call_context.h"
#include "server/base/shared_folder.h"
#include "server/policies/policy_registry.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

// Returns the tenant that a request means by `named`: empty, the caller's own. PERMISSION_DENIED if
// the caller may not read it.
absl::StatusOr<std::string> TenantOf(const Credential& caller, const std::string& named);

// Adds a version to `registry`, in the share of `tenant` of the bytes in `folder`, and fills in how
// that changes the traffic. RESOURCE_EXHAUSTED if the share has no room for it; see AddVersion().
absl::StatusOr<PolicyVersion> AddVersion(PolicyRegistry* registry, SharedFolder* folder,
                                         const std::string& tenant, const NewVersion& added,
                                         v1::TrafficChange* traffic);

// Returns the request without the bytes of the file, for the audit log.
v1::PushPolicyRequest WithoutData(const v1::PushPolicyRequest& request);

class VersionHandler {
 public:
  // All must outlive this object. `folder` is that of the policies. A policy has at most
  // `max_pushed` versions that were pushed.
  VersionHandler(PolicyRegistry* registry, SessionStore* store, SharedFolder* folder,
                 int64_t max_pushed)
      : registry_(registry), store_(store), folder_(folder), max_pushed_(max_pushed) {}

  // Each method fills in `response` and returns OK. On an error it changes nothing and returns the
  // status that policy_admin.proto names.
  absl::Status PushPolicy(CallContext& context, const v1::PushPolicyRequest& request,
                          v1::PushPolicyResponse* response) const;
  absl::Status PullPolicy(CallContext& context, const v1::PullPolicyRequest& request,
                          v1::PullPolicyResponse* response) const;
  absl::Status RemovePolicy(CallContext& context, const v1::RemovePolicyRequest& request,
                            v1::RemovePolicyResponse* response) const;

 private:
  // Returns the pushed versions that make room for another one of the policy: the oldest that
  // neither settings nor open sessions use. RESOURCE_EXHAUSTED if these are too few.
  absl::StatusOr<std::vector<PolicyVersion>> Surplus(const std::string& policy) const;
  absl::Status Remove(const PolicyVersion& version, const std::string& tenant) const;

  PolicyRegistry* const registry_;
  SessionStore* const store_;
  SharedFolder* const folder_;
  const int64_t max_pushed_;
};

}  // namespace spikeserve
