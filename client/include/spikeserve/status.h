// Converts gRPC statuses to absl::Status. Keeps the code and the message that the server sent.
//
// Free functions, safe to call from many threads.
#ifndef SPIKESERVE_STATUS_H_
#define SPIKESERVE_STATUS_H_

#include <grpcpp/support/status.h>

#include <cstdint>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Converts the status of a call.
absl::Status StatusFromGrpc(const grpc::Status& status);

// Converts the status of one item of a batch or a stream. `code` is the number of a gRPC status
// code; any other number becomes UNKNOWN.
absl::Status StatusFromCode(int32_t code, absl::string_view message);

}  // namespace spikeserve

#endif  // SPIKESERVE_STATUS_H_
