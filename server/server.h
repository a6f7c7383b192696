// A running server: creates all parts of the server, and starts and stops them in order.
#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/clock.h"
#include "server/access/certificate_watch.h"
#include "server/base/periodic.h"
#include "server/options.h"
#include "server/parts.h"
#include "server/policies/policy_poller.h"

namespace spikeserve {

//   ServerOptions options;
//   options.policies = "deploy/policies";
//   auto server = Server::Start(options);
//   if (server.ok()) std::cout << (*server)->grpc_address();
//
// Not thread-safe: one thread starts and stops it.
class Server {
 public:
  // Loads the policies and starts serving before it returns. Logs one line for each policy that
  // cannot be loaded. Errors name the flag that is wrong.
  static absl::StatusOr<std::unique_ptr<Server>> Start(const ServerOptions& options);

  // Calls Stop() if it was not called.
  ~Server();

  // The addresses that the server listens on, as HOST:PORT. Without HTTP, http_address() is empty,
  // and without datagrams, datagram_address() is.
  std::string grpc_address() const { return grpc_.transport->address().ToString(); }
  std::string datagram_address() const {
    return options_.datagram_listen.empty() ? "" : grpc_.transport->datagram_address().ToString();
  }
  std::string http_address() const {
    return http_.server == nullptr ? "" : http_.server->address().ToString();
  }

  // Stops gracefully: refuses new calls with UNAVAILABLE, sets health to NOT_SERVING, and waits at
  // most ServerOptions::drain_timeout for the answers of calls in flight.
  void Stop();

 private:
  Server(const ServerOptions& options, Foundation base);

  // Calls `work` at this interval until the server stops.
  void Every(absl::Duration interval, std::function<void()> work) {
    periodic_.push_back(std::make_unique<Periodic>(interval, std::move(work)));
  }
  void ReloadTokens();
  void StartLedger();
  absl::Status StartTransport();
  void StopTransport();
  absl::Status StartHttp();
  // Follows the other servers, and says so when this one has joined them.
  void FollowReplicas();
  // False until the settings and the heads that servers share were taken over, too.
  bool serving() const {
    return !stopping_ && !sessions_.store.draining() && membership_.has_joined();
  }
  // Returns true unless the loops of the transport are stuck.
  bool TransportResponds() const;
  void PublishHealth();

  const ServerOptions options_;
  const SteadyClock clock_;
  const Foundation base_;
  Membership membership_;
  Sessions sessions_;
  Operators operators_;
  GrpcDoor grpc_;
  HttpDoor http_;
  CertificateWatch certificates_;  // of both doors; its thread uses them
  MemoryTrimmer memory_;
  std::atomic<bool> stopping_ = false;
  bool joined_ = false;  // the value that was published last
  // Declared last, because their threads use the members above.
  std::unique_ptr<PolicyPoller> poller_;
  std::vector<std::unique_ptr<Periodic>> periodic_;
};

}  // namespace spikeserve
