// Runs a command of operators on every server of --server, and prints a row for each.
//
// Free functions. Not thread-safe: they print.
#pragma once

#include <string>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/spikectl/server_flags.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// What a command has to print about one server.
struct Answer {
  std::string text;
  nlohmann::ordered_json json;
  // All servers with the same store do what this one has done.
  bool shared = false;
};

// Calls `call` with the flags for one server after the other, and prints its answers: that of a
// single server as it is; those of several as rows that begin with the address, or as the list
// "servers" of a JSON object. After an answer that is `shared`, no other server is called. Returns
// OK if every server did it; otherwise an error that counts and names those that did not.
absl::Status OnEveryServer(const ServerFlags& flags,
                           absl::FunctionRef<absl::StatusOr<Answer>(const ServerFlags&)> call);

}  // namespace spikeserve
