// TLS for the gRPC port and the HTTP port.
#ifndef SERVER_ACCESS_TLS_H_
#define SERVER_ACCESS_TLS_H_

#include <grpcpp/security/server_credentials.h>

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

struct ssl_ctx_st;  // OpenSSL's SSL_CTX

namespace spikeserve {

// PEM files, looked at again every few seconds while the server runs, so that certificates are
// renewed without a restart. All empty: plain text.
struct TlsFiles {
  std::string certificate;  // the server's chain, its own first
  std::string key;
  std::string client_ca;  // set: clients must show a certificate that these signed

  bool enabled() const { return !certificate.empty(); }

  // INVALID_ARGUMENT names the flag, what was expected and what came.
  absl::Status Validate() const;
};

// INVALID_ARGUMENT, naming flag and file, where a file cannot be read as what it is to be, or
// certificate and key do not belong together: gRPC itself would fail every handshake in silence.
absl::StatusOr<std::shared_ptr<grpc::ServerCredentials>> MakeServerCredentials(
    const TlsFiles& files);

// Serves HTTPS with the same files, which are read for each connection, and the same demand for
// client certificates. A file that has gone bad fails the connections until it is good again.
// `files` must outlive `context`.
void SetUpTls(const TlsFiles* files, ssl_ctx_st* context);

}  // namespace spikeserve

#endif  // SERVER_ACCESS_TLS_H_
