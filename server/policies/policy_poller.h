// Keeps a registry in line with its directory, in a thread of its own, and logs what changes.
#ifndef SERVER_POLICIES_POLICY_POLLER_H_
#define SERVER_POLICIES_POLICY_POLLER_H_

#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "server/base/periodic.h"
#include "server/policies/policy_registry.h"

namespace spikeserve {

class PolicyPoller {
 public:
  // `registry` must outlive the poller. What is in `known`, the refusals that were logged before,
  // is not logged again.
  PolicyPoller(PolicyRegistry* registry, absl::Duration interval,
               const std::vector<absl::Status>& known);

 private:
  void Poll();

  PolicyRegistry* const registry_;
  std::set<std::string> logged_;  // the thread's own once it runs
  Periodic thread_;
};

}  // namespace spikeserve

#endif  // SERVER_POLICIES_POLICY_POLLER_H_
