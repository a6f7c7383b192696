// The one place where absl::Status becomes what gRPC says.
#ifndef SERVER_STATUS_MAP_H_
#define SERVER_STATUS_MAP_H_

#include <grpcpp/support/status.h>

#include <cstddef>
#include <optional>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

grpc::StatusCode ToGrpcCode(absl::StatusCode code);

// A retry delay becomes google.rpc.RetryInfo among the status's details.
grpc::Status ToGrpcStatus(const absl::Status& status);

// How long whoever was answered with `status` waits for what comes next, zero where it was no
// refusal of a caller: a token that is not good, or more than the caller's share. One who goes on
// regardless is slowed down to what costs the others nothing. A random time, a tenth of a second on
// average: callers that were refused together do not come back together. And, because long requests
// cost more, a quarter of a second for each MiB of `request_bytes`, up to a second.
absl::Duration RefusalRest(const absl::Status& status, size_t request_bytes);

// `status` with a hint of when the call may be tried again. REQUIRES: not OK.
absl::Status WithRetryDelay(absl::Status status, absl::Duration delay);

// The hint, if `status` has one.
std::optional<absl::Duration> RetryDelay(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_STATUS_MAP_H_
