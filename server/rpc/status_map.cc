#include "server/rpc/status_map.h"

#include <string>

#include "server/base/retry_delay.h"

namespace spikeserve {

// ToGrpcStatus casts: Abseil's codes have the same numbers as gRPC's.
static_assert(static_cast<int>(absl::StatusCode::kCancelled) == grpc::StatusCode::CANCELLED);
static_assert(static_cast<int>(absl::StatusCode::kUnauthenticated) ==
              grpc::StatusCode::UNAUTHENTICATED);

grpc::Status ToGrpcStatus(const absl::Status& status) {
  if (status.ok()) return grpc::Status::OK;
  return grpc::Status(static_cast<grpc::StatusCode>(status.code()), std::string(status.message()),
                      SerializedDetails(status));
}

}  // namespace spikeserve
