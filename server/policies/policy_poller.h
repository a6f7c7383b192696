// Reloads a registry from its directory at regular intervals, on its own thread, and logs changes
// and refused files.
#pragma once

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
  // `registry` must outlive the poller. `known` holds the refusals that are logged already; they
  // are not logged again.
  PolicyPoller(PolicyRegistry* registry, absl::Duration interval,
               const std::vector<absl::Status>& known);

 private:
  void Poll();

  PolicyRegistry* const registry_;
  std::set<std::string> logged_;  // used only by the thread once it runs
  Periodic thread_;
};

}  // namespace spikeserve
