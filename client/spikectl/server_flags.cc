#include "client/spikectl/server_flags.h"

#include <utility>

#include "core/base/status_macros.h"

namespace spikeserve {

void AddServerFlags(Command program, ServerFlags* flags) {
  program.Flags("Server")
      .Add("server", "HOST:PORT,...", &flags->server,
           "Address, or several; default: $SPIKESERVE_SERVER")
      .Add("connect_timeout", "DURATION", &flags->connect_timeout, "Time to reach a server")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  AddSecurityFlags(program, &flags->security);
}

namespace {

absl::StatusOr<ClientOptions> ReadClientOptions(const ServerFlags& flags) {
  ClientOptions options;
  ASSIGN_OR_RETURN(options.security, ReadSecurityOptions(flags.security));
  return options;
}

}  // namespace

absl::StatusOr<std::unique_ptr<Client>> Connect(const ServerFlags& flags) {
  ASSIGN_OR_RETURN(auto options, ReadClientOptions(flags));
  return Client::Connect(flags.server, std::move(options), flags.connect_timeout);
}

absl::StatusOr<std::unique_ptr<AdminClient>> ConnectAdmin(const ServerFlags& flags) {
  ASSIGN_OR_RETURN(auto options, ReadClientOptions(flags));
  return AdminClient::Connect(flags.server, std::move(options), flags.connect_timeout);
}

}  // namespace spikeserve
