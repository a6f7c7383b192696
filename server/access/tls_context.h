// The certificate and the settings with which the gRPC port accepts TLS.
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

namespace spikeserve {

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
                                                            const Clock* clock);

  // Returns the context for a new connection: TLS 1.2 or later, HTTP/2 (ALPN "h2") only, no
  // renegotiation, no resumption. Looks at the files again if the last look is 2 s ago; while they
  // are invalid, the last valid context stays in use.
  std::shared_ptr<ssl_ctx_st> Get();

 private:
  TlsContext(TlsFiles files, const Clock* clock) : files_(std::move(files)), clock_(clock) {}

  // Reads the contents of the files, in a fixed order.
  absl::StatusOr<std::vector<std::string>> ReadFiles() const;

  const TlsFiles files_;
  const Clock* const clock_;
  absl::Mutex mutex_;
  std::vector<std::string> contents_ ABSL_GUARDED_BY(mutex_);  // that were looked at last
  std::shared_ptr<ssl_ctx_st> context_ ABSL_GUARDED_BY(mutex_);
  absl::Duration looked_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve

#endif  // SERVER_ACCESS_TLS_CONTEXT_H_
