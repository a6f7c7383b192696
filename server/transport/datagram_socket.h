// One loop's use of the socket for datagrams, which all loops share.
//
// Knows no keys: what is received goes to a receiver, and what is sent comes from there. Nothing is
// answered here.
//
// Confined to the thread of its loop.
#pragma once

#include <array>
#include <cstddef>
#include <functional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "server/base/socket_address.h"
#include "server/transport/event_loop.h"

namespace spikeserve {

class DatagramSocket final : public EventLoop::Source {
 public:
  using Receiver = std::function<void(const SocketAddress& from, absl::string_view datagram)>;

  // `socket` is open while the loop runs. Both must outlive the object.
  DatagramSocket(int socket, EventLoop* loop) : socket_(socket), loop_(*loop) {}

  // Receives from now on. RESOURCE_EXHAUSTED if the system has no room for another watch.
  absl::Status Start(Receiver receiver);

  // Receives a batch, and leaves the rest to the next turn of a loop.
  void OnReady(uint32_t events) override;

  // Queues a datagram.
  void Send(const SocketAddress& to, std::string datagram) {
    outgoing_.push_back({to, std::move(datagram)});
  }
  // Sends what is queued. What the system does not take is lost, like anything on its way.
  void Flush();

 private:
  static constexpr size_t kBatch = 32;
  static constexpr size_t kBufferBytes = 2048;  // one that is longer arrives cut off

  struct Outgoing {
    SocketAddress to;
    std::string datagram;
  };

  const int socket_;
  EventLoop& loop_;
  Receiver receiver_;
  std::vector<Outgoing> outgoing_;
  std::array<std::array<char, kBufferBytes>, kBatch> buffers_;
};

}  // namespace spikeserve
