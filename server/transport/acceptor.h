// Accepts the connections of one listening socket and gives them to loops.
//
// Confined to the thread of the first loop.
#ifndef SERVER_TRANSPORT_ACCEPTOR_H_
#define SERVER_TRANSPORT_ACCEPTOR_H_

#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/access/tls_context.h"
#include "server/base/file_descriptor.h"
#include "server/transport/connection_table.h"
#include "server/transport/event_loop.h"
#include "server/transport/limits.h"
#include "server/transport/stranger_queue.h"
#include "server/transport/transport_loop.h"

namespace spikeserve {

class Acceptor final : public EventLoop::Source, public StrangerQueue::Waiter {
 public:
  // The loops take turns. All arguments must outlive the acceptor; `tls` is null for plain text.
  Acceptor(FileDescriptor listener, const std::vector<std::unique_ptr<TransportLoop>>* loops,
           ConnectionTable* connections, const TransportLimits* limits, TlsContext* tls);

  // Starts accepting, on the first loop.
  absl::Status Start();
  // Stops accepting and closes the listening socket.
  void Stop();

  void OnReady(uint32_t events) override;
  void OnTurn() override;

 private:
  void AcceptSome();
  // Serves a connection or refuses it.
  void Take(FileDescriptor fd, const std::string& address);
  // Accepts one connection although the process may open no more files, and closes it, so that its
  // client fails now instead of waiting, and the listener does not stay ready for ever.
  void RefuseOne();

  FileDescriptor listener_;
  const std::vector<std::unique_ptr<TransportLoop>>& loops_;
  ConnectionTable* const connections_;
  const TransportLimits& limits_;
  TlsContext* const tls_;
  FileDescriptor reserve_;  // closed to make room for RefuseOne()
  size_t next_loop_ = 0;
};

}  // namespace spikeserve

#endif  // SERVER_TRANSPORT_ACCEPTOR_H_
