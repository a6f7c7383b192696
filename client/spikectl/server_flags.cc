#include "client/spikectl/server_flags.h"

#include <utility>

namespace spikeserve {

void AddServerFlags(Command program, ServerFlags* flags) {
  program.Flags("Server")
      .Add("server", "HOST:PORT,...", &flags->server,
           "Address, or several; default: $SPIKESERVE_SERVER")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  AddSecurityFlags(program, &flags->security);
}

namespace {

absl::StatusOr<ClientOptions> ReadClientOptions(const ServerFlags& flags) {
  ClientOptions options;
  auto security = ReadSecurityOptions(flags.security);
  if (!security.ok()) return security.status();
  options.security = *std::move(security);
  return options;
}

}  // namespace

absl::StatusOr<std::unique_ptr<Client>> Connect(const ServerFlags& flags) {
  auto options = ReadClientOptions(flags);
  if (!options.ok()) return options.status();
  return Client::Connect(flags.server, *std::move(options));
}

absl::StatusOr<std::unique_ptr<AdminClient>> ConnectAdmin(const ServerFlags& flags) {
  auto options = ReadClientOptions(flags);
  if (!options.ok()) return options.status();
  return AdminClient::Connect(flags.server, *std::move(options));
}

}  // namespace spikeserve
