// Compares the policy files of the servers that share sessions. A session can go on only at servers
// that have the bytes of its version, so a server whose file differs from that of the others must
// not open sessions on it.
//
//   SharedFiles files(&registry, shared, clock);
//   files.Follow(alive);  // now and then
//   if (auto status = files.Check(served); !status.ok()) ...  // UNAVAILABLE: other bytes
//
// The first server that has a version notes which file it is, as long as it lives.
//
// Thread-safe, except that one thread at a time calls Follow().
#pragma once

#include <cstdint>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "core/agent/served_policy.h"
#include "server/policies/policy_catalog.h"
#include "server/policies/policy_registry.h"
#include "server/policies/shared_settings.h"

namespace spikeserve {

class SharedFiles {
 public:
  // Both must outlive the object.
  SharedFiles(const PolicyRegistry* registry, SharedSettings* shared)
      : registry_(*registry), shared_(*shared) {}

  // Compares again if this server, another one or the list of those that are alive has changed.
  // Blocks. Returns UNAVAILABLE if the store cannot be reached.
  absl::Status Follow(const std::vector<std::string>& alive) ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns UNAVAILABLE if other servers have another file of this version.
  absl::Status Check(const ServedPolicy& served) const ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns FAILED_PRECONDITION, which names the servers, unless all that are alive serve this file
  // of `version`; OK if this server does not serve it. Waits up to a second for servers that are
  // just loading it. UNAVAILABLE if the store cannot be reached.
  absl::Status CheckServedByAll(const PolicyVersion& version) const ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  const PolicyRegistry& registry_;
  SharedSettings& shared_;
  // Of Follow(), as of the last comparison:
  std::shared_ptr<const PolicyCatalog> catalog_;
  int64_t revision_ = -1;

  mutable absl::Mutex mutex_;
  std::vector<std::string> alive_ ABSL_GUARDED_BY(mutex_);
  std::set<std::string> different_ ABSL_GUARDED_BY(mutex_);  // "<policy>@<version>"
};

}  // namespace spikeserve
