#include "server/transport/datagram_socket.h"

#include <sys/epoll.h>
#include <sys/socket.h>

#include <algorithm>
#include <utility>

namespace spikeserve {

absl::Status DatagramSocket::Start(Receiver receiver) {
  receiver_ = std::move(receiver);
  // A datagram wakes one loop, not all of them.
  return loop_.Watch(socket_, EPOLLIN | EPOLLEXCLUSIVE, this);
}

void DatagramSocket::OnReady(uint32_t /*events*/) {
  std::array<SocketAddress, kBatch> from;
  std::array<iovec, kBatch> parts;
  std::array<mmsghdr, kBatch> messages = {};
  for (size_t i = 0; i < kBatch; ++i) {
    parts[i] = {.iov_base = buffers_[i].data(), .iov_len = kBufferBytes};
    messages[i].msg_hdr.msg_name = &from[i].storage;
    messages[i].msg_hdr.msg_namelen = sizeof(from[i].storage);
    messages[i].msg_hdr.msg_iov = &parts[i];
    messages[i].msg_hdr.msg_iovlen = 1;
  }
  const int received = recvmmsg(socket_, messages.data(), kBatch, MSG_DONTWAIT, nullptr);
  for (size_t i = 0; static_cast<int>(i) < received; ++i) {
    from[i].size = messages[i].msg_hdr.msg_namelen;
    receiver_(from[i], absl::string_view(buffers_[i].data(), messages[i].msg_len));
  }
}

void DatagramSocket::Flush() {
  for (size_t begin = 0; begin < outgoing_.size();) {
    const size_t size = std::min(kBatch, outgoing_.size() - begin);
    std::array<iovec, kBatch> parts;
    std::array<mmsghdr, kBatch> messages = {};
    for (size_t i = 0; i < size; ++i) {
      Outgoing& next = outgoing_[begin + i];
      parts[i] = {.iov_base = next.datagram.data(), .iov_len = next.datagram.size()};
      messages[i].msg_hdr.msg_name = &next.to.storage;
      messages[i].msg_hdr.msg_namelen = next.to.size;
      messages[i].msg_hdr.msg_iov = &parts[i];
      messages[i].msg_hdr.msg_iovlen = 1;
    }
    const int sent =
        sendmmsg(socket_, messages.data(), static_cast<unsigned int>(size), MSG_DONTWAIT);
    // The one that cannot be sent is left out, for example because its address has no route.
    begin += sent > 0 ? static_cast<size_t>(sent) : 1;
  }
  outgoing_.clear();
}

}  // namespace spikeserve
