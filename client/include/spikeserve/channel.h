// How a client reaches its server: the connection, its encryption, and the token every call
// carries.
//
// Free functions, safe to call from many threads.
#ifndef SPIKESERVE_CHANNEL_H_
#define SPIKESERVE_CHANNEL_H_

#include <grpcpp/channel.h>

#include <memory>
#include <string>

#include "absl/status/statusor.h"

namespace spikeserve {

// PEM files and tokens. The default is plain text without a token.
struct SecurityOptions {
  bool tls = false;         // set by any of the files below, too
  std::string ca;           // signs the server's certificate; empty: what the system trusts
  std::string certificate;  // of this client, where the server asks for one
  std::string key;
  std::string token;  // sent with every call as "authorization: Bearer TOKEN"; empty: none

  bool use_tls() const { return tls || !ca.empty() || !certificate.empty(); }
};

// What is in `path`, without white space around it: a token's file. NOT_FOUND names the path.
absl::StatusOr<std::string> ReadTokenFile(const std::string& path);

// A connection of its own to "HOST:PORT", which is made when the first call needs it and made again
// when it breaks. NOT_FOUND or INVALID_ARGUMENT names a file that cannot be used.
absl::StatusOr<std::shared_ptr<grpc::Channel>> MakeChannel(const std::string& server,
                                                           const SecurityOptions& security);

}  // namespace spikeserve

#endif  // SPIKESERVE_CHANNEL_H_
