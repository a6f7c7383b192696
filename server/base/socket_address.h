// An address as the system's calls take it. Plain data.
#pragma once

#include <sys/socket.h>

namespace spikeserve {

struct SocketAddress {
  sockaddr_storage storage = {};
  socklen_t size = 0;  // of what is used; 0: no address
};

}  // namespace spikeserve
