// The one place where gRPC's statuses become absl's. Code and message stay as the server sent them.
//
// Free functions, safe to call from many threads.
#ifndef SPIKESERVE_STATUS_H_
#define SPIKESERVE_STATUS_H_

#include <grpcpp/support/status.h>

#include <cstdint>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// The status of a call.
absl::Status StatusFromGrpc(const grpc::Status& status);

// The status of one item of a batch or a stream: `code` is gRPC's number. UNKNOWN if there is no
// such code.
absl::Status StatusFromCode(int32_t code, absl::string_view message);

}  // namespace spikeserve

#endif  // SPIKESERVE_STATUS_H_
