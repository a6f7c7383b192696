// The policy versions a server has loaded from DIR/<policy>/<version>/policy.safetensors.
//
// Immutable once loaded; safe to use from many threads.
#ifndef SERVER_POLICY_REGISTRY_H_
#define SERVER_POLICY_REGISTRY_H_

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/session/served_policy.h"

namespace spikeserve {

class PolicyRegistry {
 public:
  // Makes the observer of one policy version.
  using NewObserver = std::function<std::shared_ptr<SessionObserver>(
      const std::string& name, int64_t version, const Policy& policy)>;

  // Loads what can be loaded. What cannot be goes to `refused`, one status each, whose message
  // starts with the path; the others are served. NOT_FOUND if there is no such directory.
  static absl::StatusOr<PolicyRegistry> Load(const std::string& directory,
                                             const NewObserver& new_observer,
                                             std::vector<absl::Status>* refused);

  // A version, or the default for 0. NOT_FOUND says which policies or versions there are.
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> Find(const std::string& name,
                                                           int64_t version) const;

  // The default of a policy: its highest version. REQUIRES: List() has a policy of this name.
  int64_t DefaultVersion(const std::string& name) const;

  // Every policy version, by name, then version.
  std::vector<std::shared_ptr<const ServedPolicy>> List() const;

 private:
  std::map<std::string, std::map<int64_t, std::shared_ptr<const ServedPolicy>>> policies_;
};

}  // namespace spikeserve

#endif  // SERVER_POLICY_REGISTRY_H_
