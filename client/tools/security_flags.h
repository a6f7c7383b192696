// The flags by which the client programs are told of TLS and tokens.
#ifndef CLIENT_TOOLS_SECURITY_FLAGS_H_
#define CLIENT_TOOLS_SECURITY_FLAGS_H_

#include "absl/status/statusor.h"
#include "spikeserve/channel.h"

namespace spikeserve {

// What --tls, --tls_ca, --tls_certificate, --tls_key and --token_file say; without the last, the
// token is that of the environment variable SPIKESERVE_TOKEN, if it is set.
absl::StatusOr<SecurityOptions> SecurityFromFlags();

}  // namespace spikeserve

#endif  // CLIENT_TOOLS_SECURITY_FLAGS_H_
