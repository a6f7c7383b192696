// The flags by which client programs ask for TLS and name their token.
#ifndef CLIENT_TOOLS_SECURITY_FLAGS_H_
#define CLIENT_TOOLS_SECURITY_FLAGS_H_

#include <string>

#include "absl/status/statusor.h"
#include "core/cli/program.h"
#include "spikeserve/channel.h"

namespace spikeserve {

struct SecurityFlags {
  SecurityOptions options;  // all but the token
  std::string token_file;   // empty: the token is in the environment, if anywhere
};

// Adds the flags to `program`. `flags` must live until Program::Run returns.
void AddSecurityFlags(Command program, SecurityFlags* flags);

// Reads the token of --token_file, else of the environment variable SPIKESERVE_TOKEN. Errors name
// the flag.
absl::StatusOr<SecurityOptions> ReadSecurityOptions(const SecurityFlags& flags);

}  // namespace spikeserve

#endif  // CLIENT_TOOLS_SECURITY_FLAGS_H_
