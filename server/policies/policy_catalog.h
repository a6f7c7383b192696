// A snapshot of the served policy versions. Chooses the version that a new session is opened on.
//
//   auto route = registry.catalog()->Choose({.policy = "cartpole", .routing_key = "robot-7"});
//
// A plain value. The registry changes a copy and publishes it, so readers share a const snapshot
// without a lock.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/served_policy.h"
#include "server/policies/policy_settings.h"

namespace spikeserve {

// The request of a new session for a policy version.
struct VersionChoice {
  std::string policy;
  int64_t version = 0;           // 0: not requested
  std::string label = "";        // empty: not requested
  std::string routing_key = "";  // divides traffic: equal keys get the same version
};

// The versions that a new session is given.
struct ChosenVersions {
  std::shared_ptr<const ServedPolicy> served;
  std::shared_ptr<const ServedPolicy> shadow;  // null if there is none or it equals `served`
  bool by_rollout = false;                     // a running roll-out has chosen `served`
};

// The served versions of one policy, and the settings of operators that are in force. Every version
// that the settings name is in `versions`.
struct CatalogPolicy {
  std::map<int64_t, std::shared_ptr<const ServedPolicy>> versions;  // never empty
  PolicySettings settings;

  // Returns settings.default_version, or the highest version if it is 0.
  int64_t DefaultVersion() const;

  // Returns NOT_FOUND unless this version of the policy is served.
  absl::Status CheckVersion(const PolicyVersion& version) const;
  // Returns NOT_FOUND unless the shadow is 0 or a served version, and FAILED_PRECONDITION unless it
  // has the spaces of every version that sessions can be routed to without naming a version.
  // `name` is the policy's.
  absl::Status CheckShadow(const std::string& name, std::vector<TrafficShare> shadowed,
                           int64_t shadow_version) const;
  // Returns the error of CheckShares, NOT_FOUND if a version is not served, or the error of
  // CheckShadow.
  absl::Status CheckTraffic(const std::string& name, const std::vector<TrafficShare>& shares,
                            int64_t shadow_version) const;
};

class PolicyCatalog {
 public:
  // Returns version `version` of policy `name`, or the default version for 0. Returns NOT_FOUND,
  // which lists the known policies or versions.
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> Find(const std::string& name,
                                                           int64_t version) const;

  // Returns the version that a new session is opened on, and the version that shadows it. Returns
  // INVALID_ARGUMENT if `choice` has both a version and a label, and NOT_FOUND, which lists the
  // known policies, versions or labels.
  absl::StatusOr<ChosenVersions> Choose(const VersionChoice& choice) const;

  // Returns policy `name`. The pointer is valid as long as this catalog. Returns NOT_FOUND, which
  // lists the known policies.
  absl::StatusOr<const CatalogPolicy*> FindPolicy(const std::string& name) const;

  // Returns all policies by name.
  const std::map<std::string, CatalogPolicy>& policies() const { return policies_; }
  std::map<std::string, CatalogPolicy>& policies() { return policies_; }

  // Removes a version, if there is one, and its policy with the last one.
  void Remove(const PolicyVersion& version);

 private:
  std::map<std::string, CatalogPolicy> policies_;
};

// Returns true if both versions have the same observation size and action space, so that one can
// replace or shadow the other.
bool SameSpaces(const ServedPolicy& a, const ServedPolicy& b);

}  // namespace spikeserve
