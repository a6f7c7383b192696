#include "client/spikectl/common_flags.h"

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"

ABSL_FLAG(std::string, server, "127.0.0.1:50051", "HOST:PORT of the server");
ABSL_FLAG(bool, json, false, "Print one JSON object instead of text");

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Client>> ConnectToServer() {
  constexpr absl::Duration kPatience = absl::Seconds(3);
  const std::string server = absl::GetFlag(FLAGS_server);
  auto client = Client::Create(server);
  if (!client.ok()) return client.status();
  if (absl::Status status = (*client)->WaitForConnected(kPatience); !status.ok()) {
    return absl::Status(status.code(), absl::StrCat("--server: ", server, ": ", status.message()));
  }
  return client;
}

}  // namespace spikeserve
