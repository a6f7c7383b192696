// The flags that every command of spikectl has: the server to call, and the output format.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "client/tools/default_server.h"
#include "client/tools/security_flags.h"
#include "core/cli/program.h"
#include "spikeserve/admin_client.h"
#include "spikeserve/client.h"

namespace spikeserve {

struct ServerFlags {
  std::string server = DefaultServer();  // as Client::Connect takes it
  absl::Duration connect_timeout = absl::Seconds(3);
  bool json = false;  // print one JSON object instead of text
  SecurityFlags security;
};

// Adds the flags to `program`. `flags` must live until Program::Run returns.
void AddServerFlags(Command program, ServerFlags* flags);

// Returns a client of --server. UNAVAILABLE if no server can be reached within --connect_timeout.
absl::StatusOr<std::unique_ptr<Client>> Connect(const ServerFlags& flags);
// As Connect, for the calls of operators.
absl::StatusOr<std::unique_ptr<AdminClient>> ConnectAdmin(const ServerFlags& flags);

}  // namespace spikeserve
