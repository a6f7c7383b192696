// Decides whether a call may proceed, by the caller's token, its role and the length of its
// request. Independent of the transport: gRPC and HTTP use the same checks.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <memory>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/access/authenticator.h"
#include "server/base/method.h"

namespace spikeserve {

// Returns the caller that sent the `authorization` header, which may be empty. Returns
// UNAUTHENTICATED without a valid token, PERMISSION_DENIED if the token's role may not call
// `method`.
absl::StatusOr<std::shared_ptr<const Credential>> Admit(const Authenticator& authenticator,
                                                        absl::string_view authorization,
                                                        const Method& method);

// Returns the caller that sent the `authorization` header over HTTP, which may be empty. Returns
// UNAUTHENTICATED without a valid token, PERMISSION_DENIED unless the role may read the status
// page.
absl::StatusOr<std::shared_ptr<const Credential>> AdmitToPages(const Authenticator& authenticator,
                                                               absl::string_view authorization);

// Counts one call of `method`, or its first decision, at time `now` of a monotonic clock. Returns
// RESOURCE_EXHAUSTED if the tenant's rate is exceeded.
absl::Status AcquireRate(const Credential& caller, const Method& method, absl::Duration now);

// Checks a further request on a stream whose caller was admitted. Returns UNAUTHENTICATED if the
// token has expired or was revoked since then, and otherwise the errors of CheckSize.
absl::Status CheckStillAdmitted(const Credential& caller, int64_t request_bytes,
                                int64_t max_message_bytes);

// Returns RESOURCE_EXHAUSTED if the request is longer than `max_message_bytes`, which is the limit
// of the server, or than the limit of the caller's tenant.
absl::Status CheckSize(const Credential& caller, int64_t request_bytes, int64_t max_message_bytes);

}  // namespace spikeserve
