// The client of a fuzz target that has one connection.
#pragma once

#include <cstdint>

#include "server/transport/connection_table.h"

namespace spikeserve {

inline ClientOrigin OneClient() {
  return {.address = "192.0.2.1", .host = "192.0.2.1", .network = "192.0.2.0/24"};
}

// Closes nothing, because no other connection needs the place.
class NoCloser final : public ConnectionCloser {
 public:
  void CloseSoon(uint64_t /*number*/) override {}
};

}  // namespace spikeserve
