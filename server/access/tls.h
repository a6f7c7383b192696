// TLS for the gRPC port and the HTTP port.
#pragma once

#include <string>

#include "absl/status/status.h"

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

// Returns INVALID_ARGUMENT, which names flag and file, if a file has another content than expected
// or the key does not belong to the certificate. Returns OK if TLS is off.
absl::Status CheckTlsFiles(const TlsFiles& files);

}  // namespace spikeserve
