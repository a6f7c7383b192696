// The certificate and the settings with which a port accepts TLS.
#pragma once

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

struct ssl_ctx_st;  // OpenSSL's SSL_CTX

namespace spikeserve {

// Paths of PEM files. The server reads them again while it runs, so certificates can be renewed
// without a restart. If all paths are empty, the server speaks plain text.
struct TlsFiles {
  std::string certificate;  // the server's chain, leaf certificate first
  std::string key;          // the private key of `certificate`, without a password
  std::string client_ca;    // if set, clients must present a certificate that one of these signed

  bool enabled() const { return !certificate.empty(); }

  // Returns INVALID_ARGUMENT that names the flag if only some of the required paths are set.
  absl::Status Validate() const;
};

// The protocol of a port over TLS, and the names of ALPN that it accepts.
enum class Protocol {
  kHttp2,  // "h2", which a client has to offer
  kHttp1,  // "http/1.1", or no ALPN
};

// When certificates begin and end to be valid.
struct CertificateTimes {
  absl::Time begin;      // of the server's certificate and its chain: the latest
  absl::Time end;        // the earliest
  absl::Time client_ca;  // the earliest end of the clients' authorities; infinite: there are none

  bool valid_at(absl::Time now) const { return begin <= now && now < end; }
};

// Shares one OpenSSL context among all connections, and replaces it when its files change, so that
// certificates can be renewed without a restart. Connections keep the context that they began with.
//
// Thread-safe.
class TlsContext {
 public:
  // Reads the files. Returns an error, which names flag and file, if a file cannot be read or has
  // another content than expected, or if the key does not belong to the certificate.
  static absl::StatusOr<std::unique_ptr<TlsContext>> Create(const TlsFiles& files,
                                                            Protocol protocol);

  Protocol protocol() const { return protocol_; }

  // Returns the context for a new connection: TLS 1.2 or later with the ciphers that HTTP/2 allows
  // (RFC 9113, appendix A), the protocol above only, no renegotiation, no resumption.
  std::shared_ptr<ssl_ctx_st> Get() const;

  // Reads the files again, and uses them if they have changed; returns true if so. Returns an error
  // while the files are unusable: one is missing or has another content than expected, or the
  // certificate is not valid now although the one in use is. The current one then stays in use.
  absl::StatusOr<bool> Reload();

  // Returns the validity of the certificates in use.
  CertificateTimes times() const;

 private:
  TlsContext(TlsFiles files, Protocol protocol) : files_(std::move(files)), protocol_(protocol) {}

  // Reads the contents of the files, in a fixed order.
  absl::StatusOr<std::vector<std::string>> ReadFiles() const;

  const TlsFiles files_;
  const Protocol protocol_;
  mutable absl::Mutex mutex_;
  std::vector<std::string> contents_ ABSL_GUARDED_BY(mutex_);  // of the files in use
  std::shared_ptr<ssl_ctx_st> context_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
