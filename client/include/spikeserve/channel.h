// Connects a client to its server, with TLS and a bearer token if wanted.
//
//   auto channel = MakeChannel("robots.example:50051", {.tls = true, .token = token});
//
// Free functions, safe to call from many threads.
#ifndef SPIKESERVE_CHANNEL_H_
#define SPIKESERVE_CHANNEL_H_

#include <grpcpp/channel.h>

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/time/time.h"

namespace spikeserve {

// Encryption, authentication and signs of life. `ca`, `certificate` and `key` are paths of PEM
// files. The default is plain text without a token.
struct SecurityOptions {
  bool tls = false;         // encrypt; implied by `ca` and `certificate`
  std::string ca;           // the authorities of the server's certificate; empty: the system's
  std::string certificate;  // the client's own, for servers that require one
  std::string key;          // the private key of `certificate`
  std::string token;        // sent in every call as "authorization: Bearer TOKEN"; empty: none

  // While a call is under way, a server that has sent nothing for `keepalive` is asked for a sign
  // of life (a PING of HTTP/2), which may take `keepalive_timeout`. So may the acknowledgement of
  // sent bytes. After that, the connection is a broken one, and the next call opens another one.
  absl::Duration keepalive = absl::Seconds(10);
  absl::Duration keepalive_timeout = absl::Seconds(5);

  bool use_tls() const { return tls || !ca.empty() || !certificate.empty(); }
};

// Reads a token from the file at `path` and strips surrounding white space. Returns NOT_FOUND,
// which names the path, if the file cannot be read.
absl::StatusOr<std::string> ReadTokenFile(const std::string& path);

// Returns a channel to `server`, "HOST:PORT". It has its own connection, which is opened by the
// first call and reopened after it breaks. Returns NOT_FOUND, which names the file, if a file
// cannot be read, and INVALID_ARGUMENT if only one of `certificate` and `key` is set, or the token
// has other than printable ASCII characters.
absl::StatusOr<std::shared_ptr<grpc::Channel>> MakeChannel(const std::string& server,
                                                           const SecurityOptions& security);

}  // namespace spikeserve

#endif  // SPIKESERVE_CHANNEL_H_
