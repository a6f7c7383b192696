// Where a client connects from, for limits that count the connections of one client.
//
// Who has one IPv6 address usually has all 2^64 of its /64, and who has one IPv4 address of a /24
// often has more of them. Limits therefore count hosts and networks, not addresses.
#pragma once

#include <sys/socket.h>

#include <string>

namespace spikeserve {

struct ClientOrigin {
  std::string address;  // "192.0.2.7", "2001:db8::7"; "unix" for a socket of the file system
  std::string host;     // the IPv4 address, or the /64 of an IPv6 address: "2001:db8::/64"
  std::string network;  // the /24 of an IPv4 address, or the /48 of an IPv6 address
};

// Returns the origin of the client whose address accept() returned. An IPv4 client of an IPv6
// socket counts as what it is. Thread-safe.
ClientOrigin OriginOf(const sockaddr_storage& peer);

}  // namespace spikeserve
