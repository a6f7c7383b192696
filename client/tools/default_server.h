// The servers that a client program calls if no flag names them.
#pragma once

#include <string>

namespace spikeserve {

// Returns the environment variable SPIKESERVE_SERVER, one address or several separated by commas,
// or 127.0.0.1:50051 if it is not set. Safe to call from many threads.
std::string DefaultServer();

// Stops gRPC's own log lines on standard error, unless the environment variable GRPC_VERBOSITY asks
// for them. The statuses of calls have the errors. Call it first in main().
void SilenceGrpc();

}  // namespace spikeserve
