// What serves the connections that an Acceptor has accepted.
//
// Confined to the thread of its loop, except ConnectionCloser.
#pragma once

#include <memory>

#include "server/transport/connection_table.h"
#include "server/transport/event_loop.h"
#include "server/transport/socket.h"
#include "server/transport/unauthenticated_queue.h"

namespace spikeserve {

class ConnectionHost : public ConnectionCloser {
 public:
  // Returns the loop that calls the host. Its Post() may be called from any thread.
  virtual EventLoop& events() = 0;
  virtual UnauthenticatedQueue& unauthenticated_queue() = 0;

  // Serves a new connection.
  virtual void Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) = 0;

 protected:
  ~ConnectionHost() = default;
};

}  // namespace spikeserve
