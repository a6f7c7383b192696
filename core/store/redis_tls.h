// TLS on the connections to Redis, because Debian's hiredis has none.
#pragma once

#include <openssl/ssl.h>

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/store/redis_options.h"

namespace spikeserve {

struct SslDeleter {
  void operator()(SSL* connection) const { SSL_free(connection); }
};
using SslConnection = std::unique_ptr<SSL, SslDeleter>;

// Makes a TLS connection on the connected socket `fd`, which must outlive it. Checks that the
// server's certificate is valid for `host`. Blocks for at most the timeouts of the socket. Returns
// INVALID_ARGUMENT, which names the flag, if a file cannot be used, and UNAVAILABLE if the
// handshake fails.
absl::StatusOr<SslConnection> ConnectTls(int fd, const std::string& host,
                                         const RedisTlsFiles& files);

// Returns why the last operation of OpenSSL on this thread has failed, and forgets it.
std::string TakeTlsError();

// As TakeTlsError(), after a write on `connection` has failed. A server that closes a connection
// has the reason in an alert, which may have arrived before the write.
std::string TakeTlsErrorOfWrite(SSL* connection);

// Returns INVALID_ARGUMENT, which names the flag, if a file cannot be used.
absl::Status CheckRedisTlsFiles(const RedisTlsFiles& files);

}  // namespace spikeserve
