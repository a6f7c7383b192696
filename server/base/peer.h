// Identifies the other end of a connection.
#pragma once

#include <string>

namespace spikeserve {

struct Peer {
  std::string address;      // IP address; "unix" for a socket of the file system
  std::string certificate;  // subject of the client's certificate, RFC 2253; empty: none
};

}  // namespace spikeserve
