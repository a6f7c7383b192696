#include "server/transport/client_origin.h"

#include <arpa/inet.h>
#include <netinet/in.h>

#include <algorithm>
#include <array>
#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr size_t kHostBytes6 = 8;     // a /64
constexpr size_t kNetworkBytes6 = 6;  // a /48
constexpr size_t kNetworkBytes4 = 3;  // a /24

std::string Text(int family, const void* address) {
  std::array<char, INET6_ADDRSTRLEN> text = {};
  inet_ntop(family, address, text.data(), text.size());
  return text.data();
}

// Returns the network of the first `kept` bytes of `address`.
template <typename Address>
std::string Network(int family, Address address, size_t kept) {
  auto* const bytes = reinterpret_cast<unsigned char*>(&address);
  std::fill(bytes + kept, bytes + sizeof(address), 0);
  return absl::StrCat(Text(family, &address), "/", 8 * kept);
}

ClientOrigin Origin4(std::string text, const in_addr& address) {
  return {.address = std::move(text),
          .host = Text(AF_INET, &address),
          .network = Network(AF_INET, address, kNetworkBytes4)};
}

}  // namespace

ClientOrigin OriginOf(const sockaddr_storage& peer) {
  if (peer.ss_family == AF_INET) {
    const in_addr& address = reinterpret_cast<const sockaddr_in&>(peer).sin_addr;
    return Origin4(Text(AF_INET, &address), address);
  }
  if (peer.ss_family != AF_INET6) return {.address = "unix", .host = "unix", .network = "unix"};
  const in6_addr& address = reinterpret_cast<const sockaddr_in6&>(peer).sin6_addr;
  std::string text = Text(AF_INET6, &address);
  if (IN6_IS_ADDR_V4MAPPED(&address)) {
    in_addr inner = {};
    std::copy_n(&address.s6_addr[12], sizeof(inner), reinterpret_cast<unsigned char*>(&inner));
    return Origin4(std::move(text), inner);
  }
  return {.address = std::move(text),
          .host = Network(AF_INET6, address, kHostBytes6),
          .network = Network(AF_INET6, address, kNetworkBytes6)};
}

}  // namespace spikeserve
