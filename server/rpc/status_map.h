// Converts absl::Status to grpc::Status. All RPC code converts here.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_RPC_STATUS_MAP_H_
#define SERVER_RPC_STATUS_MAP_H_

#include <grpcpp/support/status.h>

#include "absl/status/status.h"

namespace spikeserve {

// Keeps code and message. Puts a retry delay, see WithRetryDelay, into the details of the status as
// google.rpc.RetryInfo.
grpc::Status ToGrpcStatus(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_RPC_STATUS_MAP_H_
