#include "client/spikectl/common_flags.h"

#include <utility>

#include "absl/flags/flag.h"
#include "client/security_flags.h"

ABSL_FLAG(std::string, server, "127.0.0.1:50051", "HOST:PORT of the server");
ABSL_FLAG(bool, json, false, "Print one JSON object instead of text");

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Client>> ConnectToServer() {
  ClientOptions options;
  auto security = SecurityFromFlags();
  if (!security.ok()) return security.status();
  options.security = *std::move(security);
  return Client::Connect(absl::GetFlag(FLAGS_server), std::move(options));
}

}  // namespace spikeserve
