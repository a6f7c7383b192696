// Calls unary methods of a collector by gRPC, one at a time. Keeps the connection for the next
// call.
//
// Not thread-safe.
#pragma once

#include <nghttp2/nghttp2.h>

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/trace/client_socket.h"
#include "server/trace/trace_options.h"

namespace spikeserve {

class OtlpClient {
 public:
  // Does not connect yet. INVALID_ARGUMENT: a file of TLS cannot be used; names its variable.
  static absl::StatusOr<std::unique_ptr<OtlpClient>> Create(const TraceOptions& options);
  ~OtlpClient();

  // Sends a serialized message to the method at `path` and returns its serialized response. Errors:
  // the status of the call; UNAVAILABLE without a connection; DEADLINE_EXCEEDED.
  absl::StatusOr<std::string> Call(absl::string_view path, absl::string_view message,
                                   absl::Duration timeout);

 private:
  struct Exchange;  // one call
  struct Callbacks;

  explicit OtlpClient(const TraceOptions& options) : options_(options) {}
  absl::Status ReadFiles();
  absl::Status Connect(absl::Duration end);
  void Disconnect();
  absl::StatusOr<std::string> CallOnce(absl::string_view path, absl::string_view message,
                                       absl::Duration end);
  absl::Status Submit(absl::string_view path, Exchange* exchange);
  // Sends and receives until the call is over.
  absl::Status Run(const Exchange& exchange, absl::Duration end);
  absl::Status Flush();
  absl::Status Receive();

  const TraceOptions options_;
  const SteadyClock clock_;
  std::shared_ptr<ssl_ctx_st> tls_;  // null: none
  std::unique_ptr<ClientSocket> socket_;
  nghttp2_session* session_ = nullptr;  // of `socket_`
  std::string unsent_;
};

}  // namespace spikeserve
