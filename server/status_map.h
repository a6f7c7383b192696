// The one place where absl::Status becomes what gRPC says.
#ifndef SERVER_STATUS_MAP_H_
#define SERVER_STATUS_MAP_H_

#include <grpcpp/support/status.h>

#include "absl/status/status.h"

namespace spikeserve {

grpc::StatusCode ToGrpcCode(absl::StatusCode code);

grpc::Status ToGrpcStatus(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_STATUS_MAP_H_
