// A connection to another program over TCP, with or without TLS, for a thread that may wait.
//
// Not thread-safe.
#pragma once

#include <cstddef>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/base/file_descriptor.h"

struct ssl_ctx_st;  // OpenSSL's SSL_CTX
struct ssl_st;      // OpenSSL's SSL

namespace spikeserve {

class ClientSocket {
 public:
  // Connects before `end`, a time of SteadyClock, which it may miss by the time that a name takes
  // to resolve. With `tls`, which speaks HTTP/2, checks that the certificate is one of `host`.
  // UNAVAILABLE: the other end cannot be reached or trusted. DEADLINE_EXCEEDED.
  static absl::StatusOr<std::unique_ptr<ClientSocket>> Connect(const std::string& host, int port,
                                                               ssl_ctx_st* tls, absl::Duration end);
  ~ClientSocket();

  // Both return 0 if nothing can be read or written now, and UNAVAILABLE if the connection ended.
  absl::StatusOr<size_t> Read(char* bytes, size_t size);
  absl::StatusOr<size_t> Write(absl::string_view bytes);
  // Waits until something may be read, or, if `writes`, written. DEADLINE_EXCEEDED: `end` came.
  absl::Status Wait(bool writes, absl::Duration end);

 private:
  ClientSocket() = default;
  absl::Status ConnectTo(const std::string& host, int port, absl::Duration end);
  absl::Status StartTls(const std::string& host, ssl_ctx_st* tls, absl::Duration end);
  // Returns 0 if OpenSSL has to wait, and the error otherwise.
  absl::StatusOr<size_t> TlsResult(int result);

  const SteadyClock clock_ = {};
  FileDescriptor socket_;
  ssl_st* tls_ = nullptr;    // freed by the destructor
  bool tls_writes_ = false;  // OpenSSL waits until it can write
};

}  // namespace spikeserve
