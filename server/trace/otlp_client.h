// Calls unary methods of a collector by gRPC, one at a time. Keeps the connection for the next
// call.
//
// Not thread-safe.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/trace/trace_options.h"

namespace spikeserve {

class OtlpClient {
 public:
  // Does not connect yet. INVALID_ARGUMENT: a file of TLS cannot be used; names its variable.
  static absl::StatusOr<std::unique_ptr<OtlpClient>> Create(const TraceOptions& options);
  virtual ~OtlpClient() = default;

  // Sends a serialized message to the method at `path` and returns its serialized response. Errors:
  // the status of the call; UNAVAILABLE without a connection; DEADLINE_EXCEEDED.
  virtual absl::StatusOr<std::string> Call(absl::string_view path, absl::string_view message,
                                           absl::Duration timeout) = 0;
};

}  // namespace spikeserve
