// Says why a socket cannot listen on an address, and what to do about it.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_TRANSPORT_LISTEN_REASON_H_
#define SERVER_TRANSPORT_LISTEN_REASON_H_

#include <sys/socket.h>

#include <string>

namespace spikeserve {

// Returns the reason for `error`, the errno of bind() or listen() on `address`, of the families
// AF_INET, AF_INET6 or AF_UNIX. Names the family and the numeric address, because a host name may
// have several.
std::string ListenReason(int error, const sockaddr* address, socklen_t size);

// As above, where the address that failed is not known.
std::string ListenReason(int error);

// Returns the reason for `error` of getaddrinfo() for the name `host`.
std::string ResolveReason(int error, const std::string& host);

}  // namespace spikeserve

#endif  // SERVER_TRANSPORT_LISTEN_REASON_H_
