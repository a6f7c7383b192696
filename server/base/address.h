// Network endpoints written as HOST:PORT or unix:PATH, the forms that flags take.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

struct Address {
  std::string host;            // a name, an IPv4 address, or an IPv6 address in brackets
  int port = 0;                // 0: the system picks a free port
  std::string unix_path = "";  // if set, the endpoint is this socket of the file system instead

  std::string ToString() const;

  bool is_unix() const { return !unix_path.empty(); }

  // Returns true if only this machine can connect to the address.
  bool is_loopback() const;
};

// Parses HOST:PORT. Returns INVALID_ARGUMENT with the expected and the received text, prefixed with
// `field`, if `text` has another form.
absl::StatusOr<Address> ParseAddress(absl::string_view field, absl::string_view text);

// As ParseAddress, but also parses unix:PATH.
absl::StatusOr<Address> ParseAddressOrUnix(absl::string_view field, absl::string_view text);

}  // namespace spikeserve
