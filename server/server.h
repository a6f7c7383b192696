// A running server: creates all parts of the server, and starts and stops them in order.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/options.h"

namespace spikeserve {

//   ServerOptions options;
//   options.policies = "deploy/policies";
//   auto server = Server::Start(options);
//   if (server.ok()) std::cout << (*server)->grpc_address();
//
// Not thread-safe: one thread starts and stops it. An interface, so that its users need not include
// its parts.
class Server {
 public:
  // Loads the policies and starts serving before it returns. Logs one line for each policy that
  // cannot be loaded. Errors name the flag that is wrong.
  static absl::StatusOr<std::unique_ptr<Server>> Start(const ServerOptions& options);

  // Calls Stop() if it was not called.
  virtual ~Server() = default;

  // The addresses that the server listens on, as HOST:PORT. Without HTTP, http_address() is empty,
  // and without datagrams, datagram_address() is.
  virtual std::string grpc_address() const = 0;
  virtual std::string datagram_address() const = 0;
  virtual std::string http_address() const = 0;

  // Stops gracefully: refuses new calls with UNAVAILABLE, sets health to NOT_SERVING, and waits at
  // most ServerOptions::drain_timeout for the answers of calls in flight.
  virtual void Stop() = 0;
};

}  // namespace spikeserve
