// The one place where absl::Status becomes what gRPC says.
#ifndef SERVER_BASE_STATUS_MAP_H_
#define SERVER_BASE_STATUS_MAP_H_

#include <grpcpp/support/status.h>

#include <optional>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

grpc::StatusCode ToGrpcCode(absl::StatusCode code);

// A retry delay becomes google.rpc.RetryInfo among the status's details.
grpc::Status ToGrpcStatus(const absl::Status& status);

// `status` with a hint of when the call may be tried again. REQUIRES: not OK.
absl::Status WithRetryDelay(absl::Status status, absl::Duration delay);

// The hint, if `status` has one.
std::optional<absl::Duration> RetryDelay(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_BASE_STATUS_MAP_H_
