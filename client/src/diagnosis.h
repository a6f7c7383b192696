// Says why a server cannot be reached, by trying the steps of a connection one after the other.
// gRPC reports one status for all causes, and its text differs from version to version.
//
// Free functions, safe to call from many threads. They block for at most a few seconds.
#pragma once

#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns why `server`, "HOST:PORT" or "unix:PATH", cannot be reached, or an empty string if the
// cause is not found. `tls` shows whether the client encrypts; `message` is the one of gRPC.
std::string DiagnoseConnection(const std::string& server, bool tls, absl::string_view message);

}  // namespace spikeserve
