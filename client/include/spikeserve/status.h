// Converts gRPC statuses to absl::Status. Keeps the code, the message and the time of the next try
// that the server sent.
//
// Free functions, safe to call from many threads.
#ifndef SPIKESERVE_STATUS_H_
#define SPIKESERVE_STATUS_H_

#include <grpcpp/support/status.h>

#include <cstdint>
#include <optional>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"

namespace spikeserve {

// Converts the status of a call.
absl::Status StatusFromGrpc(const grpc::Status& status);

// Converts the status of one item of a batch or a stream. `code` is the number of a gRPC status
// code; any other number becomes UNKNOWN. `retry_after_seconds` is that of the item, if it has one.
absl::Status StatusFromCode(int32_t code, absl::string_view message,
                            std::optional<double> retry_after_seconds = std::nullopt);

// Returns the time after which the server expects that the call may succeed, if it named one
// (google.rpc.RetryInfo).
std::optional<absl::Duration> RetryAfter(const absl::Status& status);

// Returns whether the server does not know the session of the call any more, because it was
// restarted or has ended the session.
bool IsSessionLost(const absl::Status& status);

// Returns `status` of a call that names a session: a NOT_FOUND becomes one for which IsSessionLost
// returns true, because a session is all that such a call can fail to find.
absl::Status ForSession(absl::Status status);

}  // namespace spikeserve

#endif  // SPIKESERVE_STATUS_H_
