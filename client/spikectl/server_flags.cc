#include "client/spikectl/server_flags.h"

#include <utility>

namespace spikeserve {

void AddServerFlags(Command program, ServerFlags* flags) {
  program.Flags("Server")
      .Add("server", "HOST:PORT,...", &flags->server,
           "Address, or several; default: $SPIKESERVE_SERVER")
      .Add("connect_timeout", "DURATION", &flags->connect_timeout,
           "Time to reach a server; without a unit: seconds")
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
  return Client::Connect(flags.server, *std::move(options), flags.connect_timeout);
}

absl::StatusOr<std::unique_ptr<AdminClient>> ConnectAdmin(const ServerFlags& flags) {
  auto options = ReadClientOptions(flags);
  if (!options.ok()) return options.status();
  return AdminClient::Connect(flags.server, *std::move(options), flags.connect_timeout);
}

}  // namespace spikeserve
