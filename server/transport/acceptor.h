// Accepts the connections of one listening socket and gives them to hosts.
//
// Confined to the thread of the first host.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "server/access/tls_context.h"
#include "server/base/file_descriptor.h"
#include "server/transport/client_origin.h"
#include "server/transport/connection_host.h"
#include "server/transport/connection_table.h"
#include "server/transport/event_loop.h"
#include "server/transport/unauthenticated_queue.h"

namespace spikeserve {

class Acceptor final : public EventLoop::Source, public UnauthenticatedQueue::Waiter {
 public:
  // The hosts take turns. All pointers must outlive the acceptor.
  struct Options {
    std::vector<ConnectionHost*> hosts;
    ConnectionTable* connections;
    absl::string_view refusal;  // sent in plain text to a client for which there is no place
    TlsContext* tls;            // null for plain text
  };
  Acceptor(FileDescriptor listener, Options options);

  // Starts accepting, on the first host's loop.
  absl::Status Start();
  // Stops accepting and closes the listening socket.
  void Stop();

  void OnReady(uint32_t events) override;
  void OnTurn() override;

 private:
  void AcceptSome();
  // Serves a connection or refuses it.
  void Take(FileDescriptor fd, const ClientOrigin& origin);
  // Accepts one connection although the process may open no more files, and closes it, so that its
  // client fails now instead of waiting, and the listener does not stay ready for ever. Closes an
  // unauthenticated one, too, so that the next client finds a file descriptor.
  void RefuseOne();

  FileDescriptor listener_;
  const Options options_;
  ConnectionHost& first_;
  FileDescriptor reserve_;  // closed to make room for RefuseOne()
  size_t next_host_ = 0;
};

}  // namespace spikeserve
