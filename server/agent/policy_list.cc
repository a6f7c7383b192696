#include "server/agent/policy_list.h"

#include <utility>

#include "server/messages/convert.h"

namespace spikeserve {

v1::ListPoliciesResponse PolicyList::Of(const std::shared_ptr<const PolicyCatalog>& catalog) {
  std::shared_ptr<const v1::ListPoliciesResponse> list;
  {
    absl::MutexLock lock(&mutex_);
    if (catalog_.lock() == catalog) list = list_;
  }
  if (list != nullptr) return *list;
  auto made = std::make_shared<v1::ListPoliciesResponse>();
  for (const auto& [name, policy] : catalog->policies()) {
    for (const auto& [version, served] : policy.versions) {
      *made->add_policies() = ToProto(policy, *served);
    }
  }
  absl::MutexLock lock(&mutex_);
  catalog_ = catalog;
  list_ = made;
  return *made;
}

}  // namespace spikeserve
