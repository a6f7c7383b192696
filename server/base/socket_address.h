// An address as the system's calls take it. Plain data.
#ifndef SERVER_BASE_SOCKET_ADDRESS_H_
#define SERVER_BASE_SOCKET_ADDRESS_H_

#include <sys/socket.h>

namespace spikeserve {

struct SocketAddress {
  sockaddr_storage storage = {};
  socklen_t size = 0;  // of what is used; 0: no address
};

}  // namespace spikeserve

#endif  // SERVER_BASE_SOCKET_ADDRESS_H_
