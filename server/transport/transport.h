// Serves gRPC over HTTP/2: listens, and runs event loops that carry the calls to routers.
//
// gRPC's protocol is implemented here on nghttp2 (framing, HPACK, flow control) and OpenSSL (TLS).
// New connections go to the loops in turn, and stay there.
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/access/tls_context.h"
#include "server/base/address.h"
#include "server/base/file_descriptor.h"
#include "server/transport/acceptor.h"
#include "server/transport/connection_table.h"
#include "server/transport/limits.h"
#include "server/transport/transport_budgets.h"
#include "server/transport/transport_loop.h"

namespace spikeserve {

struct TransportOptions {
  Address listen;
  std::optional<Address> datagram_listen = std::nullopt;  // absent: no datagrams
  TransportLimits limits;
  int loops = 1;                 // threads
  TlsContext* tls = nullptr;     // null: plain text; must outlive the transport
  const Clock* clock = nullptr;  // monotonic; must outlive the transport
};

//   auto transport = Transport::Create(options);
//   for (auto& loop : (*transport)->loops()) loop->SetRouter(...);
//   (*transport)->Start();
//   ...
//   (*transport)->Drain();  // calls are told to finish; new ones still reach the routers
//   (*transport)->Stop();
//
// Thread-safety: one thread creates, starts and stops it. Drain() and Responds() are thread-safe.
class Transport {
 public:
  // Listens, but accepts no connections yet. Errors name the flag.
  static absl::StatusOr<std::unique_ptr<Transport>> Create(const TransportOptions& options);
  ~Transport();

  // Returns the address, with the port that the system picked.
  const Address& address() const { return address_; }
  // REQUIRES: TransportOptions::datagram_listen.
  const Address& datagram_address() const { return datagram_address_; }
  const TransportLimits& limits() const { return options_.limits; }
  const std::vector<std::unique_ptr<TransportLoop>>& loops() const { return loops_; }
  const ConnectionTable& connections() const { return connections_; }
  TransportBudgets& budgets() { return budgets_; }
  const TransportBudgets& budgets() const { return budgets_; }

  absl::Status Start();

  // Calls CallHandler::OnDrain() of every call.
  void Drain();

  // Accepts no more connections, asks the clients to leave, and closes their connections when they
  // have read the last answers, or after `timeout`. Calls still open then are cancelled.
  void Stop(absl::Duration timeout);

  // Returns true if every loop finishes a turn within `timeout`.
  bool Responds(absl::Duration timeout);

 private:
  explicit Transport(const TransportOptions& options);

  // Runs `work` on every loop, and waits until it has run everywhere. Returns false after
  // `timeout`.
  bool RunOnAll(std::function<void(TransportLoop&)> work, absl::Duration timeout);

  const TransportOptions options_;
  Address address_;
  Address datagram_address_;
  FileDescriptor datagrams_;  // of all loops
  TransportBudgets budgets_;
  ConnectionTable connections_;
  std::vector<std::unique_ptr<TransportLoop>> loops_;
  std::vector<std::unique_ptr<Acceptor>> acceptors_;
  bool running_ = false;
};

}  // namespace spikeserve
