#include "client/spikectl/server_flags.h"

#include <utility>

namespace spikeserve {

void AddServerFlags(Command program, ServerFlags* flags) {
  program.Flags("Server")
      .Add("server", "HOST:PORT", &flags->server, "Address of the server")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  AddSecurityFlags(program, &flags->security);
}

absl::StatusOr<std::unique_ptr<Client>> Connect(const ServerFlags& flags) {
  ClientOptions options;
  auto security = ReadSecurityOptions(flags.security);
  if (!security.ok()) return security.status();
  options.security = *std::move(security);
  return Client::Connect(flags.server, std::move(options));
}

}  // namespace spikeserve
