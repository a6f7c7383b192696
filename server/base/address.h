// HOST:PORT, as flags name an endpoint.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_BASE_ADDRESS_H_
#define SERVER_BASE_ADDRESS_H_

#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

struct Address {
  std::string host;  // a name, an IPv4 address, or an IPv6 address in brackets
  int port = 0;      // 0 picks a free one

  std::string ToString() const;

  // Whether only this machine can connect to it.
  bool is_loopback() const;
};

// INVALID_ARGUMENT names `field`, what was expected and what came.
absl::StatusOr<Address> ParseAddress(absl::string_view field, absl::string_view text);

}  // namespace spikeserve

#endif  // SERVER_BASE_ADDRESS_H_
