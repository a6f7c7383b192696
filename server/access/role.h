// What a caller may do.
#ifndef SERVER_ACCESS_ROLE_H_
#define SERVER_ACCESS_ROLE_H_

#include <string_view>

#include "absl/status/status.h"
#include "server/metrics/metrics.h"

namespace spikeserve {

enum class Role {
  kAgent,     // plays: opens sessions, and uses those of its tenant
  kViewer,    // looks: policies, sessions, heads, and the status page
  kOperator,  // does everything
};

std::string_view ToString(Role role);
bool FromString(std::string_view name, Role* role);

// PERMISSION_DENIED where the role may not call `method`.
absl::Status CheckMayCall(Role role, Method method);

// PERMISSION_DENIED where the role may not see the status page and the metrics.
absl::Status CheckMayWatch(Role role);

}  // namespace spikeserve

#endif  // SERVER_ACCESS_ROLE_H_
