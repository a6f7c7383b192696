// Whether a call is let in: its token, what its role may do, and how long its request is.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_ACCESS_ADMISSION_H_
#define SERVER_ACCESS_ADMISSION_H_

#include <google/protobuf/message_lite.h>
#include <grpcpp/server_context.h>

#include <cstdint>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/access/authenticator.h"
#include "server/metrics/metrics.h"

namespace spikeserve {

// Who calls. UNAUTHENTICATED or PERMISSION_DENIED where they may not.
absl::StatusOr<const Credential*> Admit(const Authenticator& authenticator,
                                        const grpc::CallbackServerContext& context, Method method);

// Who sent an HTTP Authorization header, which may be empty. UNAUTHENTICATED or PERMISSION_DENIED
// unless they are a viewer or an operator, who may see the status page.
absl::StatusOr<const Credential*> AdmitToPages(const Authenticator& authenticator,
                                               absl::string_view header);

// For a request on a stream whose caller was admitted: whether the token still holds, and
// CheckSize.
absl::Status CheckStillAdmitted(const Credential& caller,
                                const google::protobuf::MessageLite& request,
                                int64_t max_message_bytes);

// RESOURCE_EXHAUSTED where the request is longer than `max_message_bytes`, the server's limit, or
// than its tenant may send.
absl::Status CheckSize(const Credential& caller, const google::protobuf::MessageLite& request,
                       int64_t max_message_bytes);

}  // namespace spikeserve

#endif  // SERVER_ACCESS_ADMISSION_H_
