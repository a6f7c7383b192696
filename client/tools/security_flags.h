// The flags of client programs for TLS and the token.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/cli/program.h"
#include "spikeserve/channel.h"

namespace spikeserve {

struct SecurityFlags {
  SecurityOptions options;  // without the token
  std::string token_file;   // empty: the token may be in the environment
};

// Adds the flags to `program`. `flags` must live until Program::Run returns.
void AddSecurityFlags(Command program, SecurityFlags* flags);

// Returns the options with the token, which is read from --token_file or, without that flag, from
// the environment variable SPIKESERVE_TOKEN. Errors name the flag.
absl::StatusOr<SecurityOptions> ReadSecurityOptions(const SecurityFlags& flags);

}  // namespace spikeserve
