// Converts absl::Status to grpc::Status. All RPC code converts here.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_BASE_STATUS_MAP_H_
#define SERVER_BASE_STATUS_MAP_H_

#include <grpcpp/support/status.h>

#include <optional>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

grpc::StatusCode ToGrpcCode(absl::StatusCode code);

// Keeps code and message. Puts a retry delay, see WithRetryDelay, into the details of the status as
// google.rpc.RetryInfo.
grpc::Status ToGrpcStatus(const absl::Status& status);

// Returns `status` with `delay` attached: the time after which the caller may retry. REQUIRES:
// `status` is not OK.
absl::Status WithRetryDelay(absl::Status status, absl::Duration delay);

// Returns the delay that WithRetryDelay attached to `status`, if any.
std::optional<absl::Duration> RetryDelay(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_BASE_STATUS_MAP_H_
