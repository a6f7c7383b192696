// Opens the sockets that a server listens on.
//
// Free functions; not thread-safe with respect to one unix: path.
#pragma once

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/base/address.h"
#include "server/base/file_descriptor.h"

namespace spikeserve {

struct Listeners {
  std::vector<FileDescriptor> sockets;
  Address address;  // with the port that the system picked
};

// Listens on every address that the host of `address` has, with one port, or on a unix: path, where
// a socket that a dead server left behind is replaced. Returns UNAVAILABLE with the system's
// reason, prefixed with `field`, if an address cannot be used, for example because another process
// listens there.
absl::StatusOr<Listeners> Listen(absl::string_view field, const Address& address);

// Opens a socket for datagrams at the first usable address of the host. Errors as for Listen().
absl::StatusOr<Listeners> ListenToDatagrams(absl::string_view field, const Address& address);

}  // namespace spikeserve
