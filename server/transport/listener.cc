#include "server/transport/listener.h"

#include <netdb.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>

#include <cerrno>
#include <cstring>
#include <memory>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

constexpr int kBacklog = 1024;

struct FreeAddresses {
  void operator()(addrinfo* addresses) const { freeaddrinfo(addresses); }
};

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
std::string PlaceOf(const sockaddr* address, socklen_t size) {
  char host[NI_MAXHOST];
  if (address->sa_family == AF_UNIX ||
      getnameinfo(address, size, host, sizeof(host), nullptr, 0, NI_NUMERICHOST) != 0) {
    return "";
  }
  return absl::StrCat(" (", address->sa_family == AF_INET6 ? "IPv6 " : "IPv4 ", host, ")");
}

// Names the family and the numeric address, because a host name may have several.
std::string ListenReason(int error, const sockaddr* address, socklen_t size) {
  return absl::StrCat(std::strerror(error), PlaceOf(address, size), Advice(error));
}

absl::Status CannotListen(absl::string_view field, const Address& address, absl::string_view why) {
  return absl::UnavailableError(
      absl::StrCat(field, ": cannot listen on ", address.ToString(), ": ", why));
}

uint16_t PortOf(int socket) {
  sockaddr_storage bound = {};
  socklen_t size = sizeof(bound);
  getsockname(socket, reinterpret_cast<sockaddr*>(&bound), &size);
  return ntohs(bound.ss_family == AF_INET6 ? reinterpret_cast<sockaddr_in6*>(&bound)->sin6_port
                                           : reinterpret_cast<sockaddr_in*>(&bound)->sin_port);
}

void SetPort(uint16_t port, sockaddr* address) {
  if (address->sa_family == AF_INET6) {
    reinterpret_cast<sockaddr_in6*>(address)->sin6_port = htons(port);
  } else {
    reinterpret_cast<sockaddr_in*>(address)->sin_port = htons(port);
  }
}

// Returns an invalid descriptor, with the reason in errno, if that fails.
FileDescriptor BindAndListen(int type, const sockaddr* address, socklen_t size) {
  FileDescriptor listener(socket(address->sa_family, type | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  const bool is_stream = type == SOCK_STREAM;
  const int yes = 1;
  // For datagrams, it would let another program share the port.
  if (is_stream) setsockopt(listener.get(), SOL_SOCKET, SO_REUSEADDR, &yes, sizeof(yes));
  if (address->sa_family == AF_INET6) {
    const int no = 0;  // "[::]" serves IPv4, too
    setsockopt(listener.get(), IPPROTO_IPV6, IPV6_V6ONLY, &no, sizeof(no));
  }
  if (bind(listener.get(), address, size) != 0 ||
      (is_stream && listen(listener.get(), kBacklog) != 0)) {
    return FileDescriptor();
  }
  return listener;
}

// Removes the socket of a server that does not run any more.
void RemoveStale(const sockaddr_un& address) {
  struct stat found = {};
  if (stat(address.sun_path, &found) != 0 || !S_ISSOCK(found.st_mode)) return;
  const FileDescriptor probe(socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
  const auto* generic = reinterpret_cast<const sockaddr*>(&address);
  if (connect(probe.get(), generic, sizeof(address)) != 0 && errno == ECONNREFUSED) {
    unlink(address.sun_path);
  }
}

absl::StatusOr<Listeners> ListenUnix(absl::string_view field, const Address& address) {
  sockaddr_un path = {.sun_family = AF_UNIX, .sun_path = {}};
  if (address.unix_path.size() >= sizeof(path.sun_path)) {
    return InvalidArgument(
        field, absl::StrCat("a path of at most ", sizeof(path.sun_path) - 1, " bytes after unix:"),
        address.unix_path.size());
  }
  std::memcpy(path.sun_path, address.unix_path.data(), address.unix_path.size());
  RemoveStale(path);
  const auto* generic = reinterpret_cast<const sockaddr*>(&path);
  FileDescriptor listener = BindAndListen(SOCK_STREAM, generic, sizeof(path));
  if (!listener.valid()) {
    return CannotListen(field, address, ListenReason(errno, generic, sizeof(path)));
  }
  Listeners result = {.sockets = {}, .address = address};
  result.sockets.push_back(std::move(listener));
  return result;
}

absl::StatusOr<Listeners> ListenInet(absl::string_view field, const Address& address, int type) {
  absl::string_view host = address.host;
  if (host.front() == '[') host = host.substr(1, host.size() - 2);
  addrinfo hints = {};
  hints.ai_flags = AI_PASSIVE;
  hints.ai_socktype = type;
  addrinfo* found = nullptr;
  const int error = getaddrinfo(std::string(host).c_str(), nullptr, &hints, &found);
  if (error != 0) {
    return CannotListen(
        field, address,
        absl::StrCat("the host name ", host, " cannot be resolved: ", gai_strerror(error)));
  }
  const std::unique_ptr<addrinfo, FreeAddresses> addresses(found);
  Listeners result = {.sockets = {}, .address = address};
  for (addrinfo* next = addresses.get(); next != nullptr; next = next->ai_next) {
    SetPort(static_cast<uint16_t>(result.address.port), next->ai_addr);
    FileDescriptor listener = BindAndListen(type, next->ai_addr, next->ai_addrlen);
    // A name may have an address of a family that this machine does not serve.
    if (!listener.valid() && (errno == EAFNOSUPPORT || errno == EADDRNOTAVAIL)) continue;
    if (!listener.valid()) {
      return CannotListen(field, address, ListenReason(errno, next->ai_addr, next->ai_addrlen));
    }
    result.address.port = PortOf(listener.get());
    result.sockets.push_back(std::move(listener));
  }
  if (result.sockets.empty()) {
    return CannotListen(field, address,
                        absl::StrCat(std::strerror(EADDRNOTAVAIL), Advice(EADDRNOTAVAIL)));
  }
  return result;
}

}  // namespace

absl::StatusOr<Listeners> Listen(absl::string_view field, const Address& address) {
  return address.is_unix() ? ListenUnix(field, address) : ListenInet(field, address, SOCK_STREAM);
}

absl::StatusOr<Listeners> ListenToDatagrams(absl::string_view field, const Address& address) {
  auto listeners = ListenInet(field, address, SOCK_DGRAM);
  if (listeners.ok()) listeners->sockets.resize(1);
  return listeners;
}

}  // namespace spikeserve
