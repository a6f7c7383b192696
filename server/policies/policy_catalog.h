// Which policy versions are served, and which of them a new session gets: a snapshot.
//
// A value: the registry changes a copy and publishes it, so readers share one without a lock.
#ifndef SERVER_POLICIES_POLICY_CATALOG_H_
#define SERVER_POLICIES_POLICY_CATALOG_H_

#include <cstdint>
#include <map>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/session/served_policy.h"
#include "server/policies/policy_settings.h"

namespace spikeserve {

// What a new session asks for.
struct VersionChoice {
  std::string policy;
  int64_t version = 0;           // 0: not named
  std::string label = "";        // empty: not named
  std::string routing_key = "";  // equal keys get equal versions where traffic is divided
};

// What it gets.
struct Route {
  std::shared_ptr<const ServedPolicy> served;
  std::shared_ptr<const ServedPolicy> shadow;  // null: none, or `served` itself
};

// The versions of one policy, and what holds of an operator's settings: every version that they
// name is in `versions`.
struct CatalogPolicy {
  std::map<int64_t, std::shared_ptr<const ServedPolicy>> versions;  // never empty
  PolicySettings settings;

  int64_t DefaultVersion() const;
};

class PolicyCatalog {
 public:
  // A version, or the default for 0. NOT_FOUND says which policies or versions there are.
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> Find(const std::string& name,
                                                           int64_t version) const;

  // The version a new session is opened on, and the one that shadows it. INVALID_ARGUMENT for a
  // choice of both version and label; NOT_FOUND says which policies, versions or labels there are.
  absl::StatusOr<Route> Choose(const VersionChoice& choice) const;

  // NOT_FOUND says which policies there are.
  absl::StatusOr<const CatalogPolicy*> FindPolicy(const std::string& name) const;

  // Every policy by name.
  const std::map<std::string, CatalogPolicy>& policies() const { return policies_; }
  std::map<std::string, CatalogPolicy>& policies() { return policies_; }

 private:
  std::map<std::string, CatalogPolicy> policies_;
};

// Whether a version can stand in for another: equal observations and actions.
bool SameSpaces(const ServedPolicy& a, const ServedPolicy& b);

}  // namespace spikeserve

#endif  // SERVER_POLICIES_POLICY_CATALOG_H_
