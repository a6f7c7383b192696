#include "client/tools/default_server.h"

#include <cstdlib>

namespace spikeserve {

std::string DefaultServer() {
  const char* server = std::getenv("SPIKESERVE_SERVER");
  return server == nullptr || *server == '\0' ? "127.0.0.1:50051" : server;
}

void SilenceGrpc() { setenv("GRPC_VERBOSITY", "NONE", /*overwrite=*/0); }

}  // namespace spikeserve
