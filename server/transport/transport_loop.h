// One event loop of the transport, its connections, its router and its thread.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <thread>

#include "absl/container/flat_hash_map.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/clock.h"
#include "server/transport/call.h"
#include "server/transport/connection.h"
#include "server/transport/connection_host.h"
#include "server/transport/connection_table.h"
#include "server/transport/datagram_socket.h"
#include "server/transport/event_loop.h"
#include "server/transport/limits.h"
#include "server/transport/socket.h"

namespace spikeserve {

// Thread-safety: Run(), Join(), CloseSoon() and events().Post() may be called from any thread,
// everything else from the loop's thread, or before Run().
class TransportLoop final : public ConnectionHost {
 public:
  // All pointers must outlive the loop.
  static absl::StatusOr<std::unique_ptr<TransportLoop>> Create(const TransportLimits* limits,
                                                               TransportBudgets* budgets,
                                                               const Clock* clock);
  ~TransportLoop();
  TransportLoop(const TransportLoop&) = delete;
  TransportLoop& operator=(const TransportLoop&) = delete;

  // ConnectionHost
  EventLoop& events() override { return *events_; }
  UnauthenticatedQueue& unauthenticated_queue() override { return shared_.unauthenticated_queue; }
  void Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) override;
  void CloseSoon(uint64_t number) override;

  // Sets what answers the calls. `router` must outlive the loop's run.
  void SetRouter(CallRouter* router) { shared_.router = router; }
  CallRouter* router() { return shared_.router; }
  // Adds a socket for datagrams, which the loop flushes with its connections. `socket` is open
  // while the loop runs.
  void AddDatagrams(int socket) {
    datagrams_ = std::make_unique<DatagramSocket>(socket, events_.get());
  }
  DatagramSocket* datagrams() { return datagrams_.get(); }  // null: there is none
  // Calls `work` at the end of each turn, before connections write.
  void AtEndOfTurn(std::function<void()> work) { events_->AtEndOfTurn(std::move(work)); }

  // Starts the loop's thread.
  void Run();
  // Stops the thread and closes all connections.
  void Join();

  // Writes what the connections have to send. The loop does this at the end of each turn; work that
  // continues after its answers calls it earlier.
  void FlushWrites();
  // Tells the handlers of all calls that the server stops.
  void Drain();
  // Asks all clients to leave (GOAWAY).
  void GoAway();
  // Returns true if every connection is closed.
  bool empty() const { return connections_.empty(); }

 private:
  TransportLoop(const TransportLimits* limits, TransportBudgets* budgets, const Clock* clock,
                std::unique_ptr<EventLoop> events);

  void CheckTimes();

  const std::unique_ptr<EventLoop> events_;
  Connection::Shared shared_;
  absl::flat_hash_map<uint64_t, std::unique_ptr<Connection>> connections_;  // by their numbers
  std::unique_ptr<DatagramSocket> datagrams_;
  std::thread thread_;
};

}  // namespace spikeserve
