#include "server/transport/listen_reason.h"

#include <netdb.h>

#include <cerrno>
#include <cstring>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

std::string Advice(int error) {
  switch (error) {
    case EADDRINUSE:
      return ": another program listens there; stop it or choose another address; port 0 picks a "
             "free one";
    case EACCES:
      return ": a port below 1024 needs the capability CAP_NET_BIND_SERVICE, and a socket of the "
             "file system a directory that the server may write to";
    case EADDRNOTAVAIL:
      return ": it is no address of this machine";
    default:
      return "";
  }
}

// Returns " (IPv4 127.0.0.1)", or an empty string for a socket of the file system.
std::string Place(const sockaddr* address, socklen_t size) {
  char host[NI_MAXHOST];
  if (address->sa_family == AF_UNIX ||
      getnameinfo(address, size, host, sizeof(host), nullptr, 0, NI_NUMERICHOST) != 0) {
    return "";
  }
  return absl::StrCat(" (", address->sa_family == AF_INET6 ? "IPv6 " : "IPv4 ", host, ")");
}

}  // namespace

std::string ListenReason(int error, const sockaddr* address, socklen_t size) {
  return absl::StrCat(std::strerror(error), Place(address, size), Advice(error));
}

std::string ListenReason(int error) { return absl::StrCat(std::strerror(error), Advice(error)); }

std::string ResolveReason(int error, const std::string& host) {
  return absl::StrCat("the host name ", host, " cannot be resolved: ", gai_strerror(error));
}

}  // namespace spikeserve
