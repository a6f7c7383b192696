#include "client/src/diagnosis.h"

#include <fcntl.h>
#include <netdb.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <memory>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"

namespace spikeserve {
namespace {

constexpr int kMilliseconds = 2000;  // for each step
constexpr char kExpectsTls[] = "the server expects TLS, and the client does not use it";

// A socket that is closed at the end of its life.
class Socket {
 public:
  explicit Socket(int descriptor) : descriptor_(descriptor) {}
  ~Socket() {
    if (descriptor_ >= 0) close(descriptor_);
  }
  Socket(Socket&& other) noexcept : descriptor_(std::exchange(other.descriptor_, -1)) {}
  Socket& operator=(Socket&&) = delete;

  int get() const { return descriptor_; }

 private:
  int descriptor_;
};

bool Await(int descriptor, int16_t events) {
  pollfd waiting = {.fd = descriptor, .events = events, .revents = 0};
  return poll(&waiting, 1, kMilliseconds) == 1;
}

// Connects within kMilliseconds. Returns 0 or an error number.
int ConnectWithin(int descriptor, const sockaddr* address, socklen_t size) {
  fcntl(descriptor, F_SETFL, fcntl(descriptor, F_GETFL) | O_NONBLOCK);
  if (connect(descriptor, address, size) == 0) return 0;
  if (errno != EINPROGRESS) return errno;
  if (!Await(descriptor, POLLOUT)) return ETIMEDOUT;
  int error = 0;
  socklen_t length = sizeof(error);
  getsockopt(descriptor, SOL_SOCKET, SO_ERROR, &error, &length);
  return error;
}

absl::StatusOr<Socket> ConnectToPath(absl::string_view path) {
  sockaddr_un address = {};
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof(address.sun_path)) {
    return absl::UnavailableError(absl::StrCat(path, ": the path is too long for a socket"));
  }
  std::memcpy(address.sun_path, path.data(), path.size());
  Socket made(socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
  const auto* generic = reinterpret_cast<const sockaddr*>(&address);
  if (const int error = ConnectWithin(made.get(), generic, sizeof(address)); error != 0) {
    return absl::UnavailableError(absl::StrCat(path, ": ", std::strerror(error)));
  }
  return made;
}

std::string ReasonOf(int error, absl::string_view host, absl::string_view port) {
  if (error == ECONNREFUSED) {
    return absl::StrCat("connection refused: no server listens on port ", port, " of ", host);
  }
  if (error == ETIMEDOUT) {
    return absl::StrCat("no answer within ", kMilliseconds / 1000, " s; a firewall may block port ",
                        port);
  }
  return std::strerror(error);
}

absl::StatusOr<Socket> ConnectTo(const std::string& server) {
  absl::string_view rest = server;
  if (absl::ConsumePrefix(&rest, "unix:")) {
    absl::ConsumePrefix(&rest, "//");
    return ConnectToPath(rest);
  }
  absl::ConsumePrefix(&rest, "dns:///");
  const size_t colon = rest.rfind(':');
  int number = 0;
  if (colon == absl::string_view::npos || !absl::SimpleAtoi(rest.substr(colon + 1), &number)) {
    return absl::UnavailableError(
        absl::StrCat("expected HOST:PORT or unix:PATH, received ", server));
  }
  const std::string port(rest.substr(colon + 1));
  absl::string_view bare = rest.substr(0, colon);
  if (absl::ConsumePrefix(&bare, "[")) absl::ConsumeSuffix(&bare, "]");
  const std::string host(bare);
  addrinfo hints = {};
  hints.ai_socktype = SOCK_STREAM;
  addrinfo* found = nullptr;
  if (const int error = getaddrinfo(host.c_str(), port.c_str(), &hints, &found); error != 0) {
    return absl::UnavailableError(
        absl::StrCat("the host name ", host, " cannot be resolved: ", gai_strerror(error)));
  }
  const std::unique_ptr<addrinfo, decltype(&freeaddrinfo)> owner(found, &freeaddrinfo);
  int error = ECONNREFUSED;
  for (const addrinfo* address = found; address != nullptr; address = address->ai_next) {
    Socket made(socket(address->ai_family, SOCK_STREAM | SOCK_CLOEXEC, 0));
    error = ConnectWithin(made.get(), address->ai_addr, address->ai_addrlen);
    if (error == 0) return made;
  }
  return absl::UnavailableError(ReasonOf(error, host, port));
}

// Sends `request` on a new connection. Returns the first bytes of the reply, which are empty if the
// server closed the connection, or nothing within kMilliseconds.
absl::StatusOr<std::string> FirstBytes(const std::string& server, absl::string_view request,
                                       bool* closed) {
  auto connection = ConnectTo(server);
  if (!connection.ok()) return connection.status();
  (void)send(connection->get(), request.data(), request.size(), MSG_NOSIGNAL);
  char buffer[16];
  const bool readable = Await(connection->get(), POLLIN);
  const ssize_t size = readable ? recv(connection->get(), buffer, sizeof(buffer), 0) : 0;
  *closed = readable && size <= 0;
  return std::string(buffer, static_cast<size_t>(size > 0 ? size : 0));
}

// The start of an HTTP/2 connection, and the start of a TLS handshake that no server completes.
constexpr absl::string_view kPreface("PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\4\0\0\0\0\0", 33);
constexpr absl::string_view kHello("\x16\x03\x01\x00\x04\x01\x00\x00\x00", 9);
constexpr char kSettingsFrame = 4;

bool IsTlsRecord(absl::string_view bytes) {
  return !bytes.empty() && (bytes[0] == '\x15' || bytes[0] == '\x16');
}

std::string DiagnosePlain(const std::string& server) {
  bool closed = false;
  const auto reply = FirstBytes(server, kPreface, &closed);
  if (!reply.ok()) return std::string(reply.status().message());
  if (reply->size() > 3 && (*reply)[3] == kSettingsFrame) return "";
  if (absl::StartsWith(*reply, "HTTP/1")) {
    return "the port speaks HTTP/1 and not gRPC: perhaps it is that of the status page "
           "(--http_listen)";
  }
  if (IsTlsRecord(*reply)) return kExpectsTls;
  bool ignored = false;
  const auto hello = FirstBytes(server, kHello, &ignored);
  if (hello.ok() && IsTlsRecord(*hello)) return kExpectsTls;
  return closed || !reply->empty()
             ? "the port does not speak gRPC"
             : "the port accepts connections and does not speak gRPC: it sends nothing";
}

std::string DiagnoseTls(const std::string& server, absl::string_view message) {
  bool closed = false;
  const auto reply = FirstBytes(server, kHello, &closed);
  if (!reply.ok()) return std::string(reply.status().message());
  if (!reply->empty() && !IsTlsRecord(*reply)) {
    return "the server does not speak TLS, and the client uses it";
  }
  if (reply->empty()) {
    const auto plain = FirstBytes(server, kPreface, &closed);
    if (plain.ok() && plain->size() > 3 && (*plain)[3] == kSettingsFrame) {
      return "the server does not speak TLS, and the client uses it";
    }
  }
  const std::string lower = absl::AsciiStrToLower(message);
  if (absl::StrContains(lower, "certificate_verify_failed") ||
      absl::StrContains(lower, "certificate verify failed")) {
    return "the certificate of the server is not accepted: expected one that the authority of the "
           "client has signed for this host name";
  }
  return "the TLS handshake failed: expected a certificate of the server that the authority of the "
         "client has signed for this host name, and a certificate of the client if the server "
         "requires one";
}

}  // namespace

std::string DiagnoseConnection(const std::string& server, bool tls, absl::string_view message) {
  return tls ? DiagnoseTls(server, message) : DiagnosePlain(server);
}

}  // namespace spikeserve
