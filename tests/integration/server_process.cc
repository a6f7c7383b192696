#include "tests/integration/server_process.h"

#include <csignal>

#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<ServerProcess>> ServerProcess::Start(
    const std::string& policies, const std::vector<std::string>& flags) {
  std::vector<std::string> arguments = {SPIKESERVE_PROGRAM, absl::StrCat("--policies=", policies),
                                        "--listen=127.0.0.1:0", "--http_listen=127.0.0.1:0",
                                        "--reflection_v1alpha"};
  arguments.insert(arguments.end(), flags.begin(), flags.end());
  auto process = Subprocess::Start(arguments);
  if (!process.ok()) return process.status();

  auto server = std::unique_ptr<ServerProcess>(new ServerProcess());
  server->process_ = *std::move(process);
  while (server->grpc_address_.empty() || server->http_address_.empty()) {
    const auto line = server->process_->ReadLine();
    if (!line.has_value()) {
      const int code = server->Wait();
      return absl::InternalError(
          absl::StrCat("spikeserve ended with code ", code, ": ", server->Log()));
    }
    absl::string_view text = *line;
    if (absl::ConsumePrefix(&text, "spikeserve: serving gRPC on ")) {
      server->grpc_address_ = std::string(text);
    } else if (absl::ConsumePrefix(&text, "spikeserve: serving HTTP on ")) {
      server->http_address_ = std::string(text);
    }
  }
  return server;
}

void ServerProcess::RequestStop() { process_->Signal(SIGTERM); }

int ServerProcess::Stop() {
  RequestStop();
  return Wait();
}

}  // namespace spikeserve
