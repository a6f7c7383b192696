// The certificate and the settings with which a port accepts TLS.
#ifndef SERVER_ACCESS_TLS_CONTEXT_H_
#define SERVER_ACCESS_TLS_CONTEXT_H_

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/access/tls.h"

struct ssl_ctx_st;  // OpenSSL's SSL_CTX

namespace spikeserve {

// What a port speaks over TLS, and what it accepts by ALPN.
enum class Protocol {
  kHttp2,  // "h2", which a client has to offer
  kHttp1,  // "http/1.1", or no ALPN
};

// Shares one OpenSSL context among all connections, and replaces it when its files change, so that
// certificates can be renewed without a restart. Connections keep the context that they began with.
//
// Thread-safe.
class TlsContext {
 public:
  // Reads the files. `clock` is monotonic and must outlive the context. Returns INVALID_ARGUMENT,
  // which names flag and file, if a file has another content than expected or the key does not
  // belong to the certificate.
  static absl::StatusOr<std::unique_ptr<TlsContext>> Create(const TlsFiles& files,
                                                            Protocol protocol, const Clock* clock);

  Protocol protocol() const { return protocol_; }

  // Returns the context for a new connection: TLS 1.2 or later, the protocol above only, no
  // renegotiation, no resumption. Looks at the files again if the last look is 2 s ago; while they
  // are invalid, the last valid context stays in use.
  std::shared_ptr<ssl_ctx_st> Get();

 private:
  TlsContext(TlsFiles files, Protocol protocol, const Clock* clock)
      : files_(std::move(files)), protocol_(protocol), clock_(clock) {}

  // Reads the contents of the files, in a fixed order.
  absl::StatusOr<std::vector<std::string>> ReadFiles() const;

  const TlsFiles files_;
  const Protocol protocol_;
  const Clock* const clock_;
  absl::Mutex mutex_;
  std::vector<std::string> contents_ ABSL_GUARDED_BY(mutex_);  // that were looked at last
  std::shared_ptr<ssl_ctx_st> context_ ABSL_GUARDED_BY(mutex_);
  absl::Duration looked_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve

#endif  // SERVER_ACCESS_TLS_CONTEXT_H_
