// Checks what a role may do.
//
// Pure functions; safe to call from many threads.
#ifndef SERVER_ACCESS_PERMISSION_H_
#define SERVER_ACCESS_PERMISSION_H_

#include "absl/status/status.h"
#include "server/access/role.h"
#include "server/base/method.h"

namespace spikeserve {

// Returns PERMISSION_DENIED if `role` may not call `method`.
absl::Status CheckMayCall(Role role, const Method& method);

// Returns PERMISSION_DENIED if `role` may not read the status page and the metrics.
absl::Status CheckMayReadStatus(Role role);

}  // namespace spikeserve

#endif  // SERVER_ACCESS_PERMISSION_H_
