#include "server/transport/acceptor.h"

#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/epoll.h>
#include <sys/socket.h>

#include <cerrno>
#include <memory>
#include <utility>

#include "server/base/log.h"
#include "server/transport/socket.h"

namespace spikeserve {
namespace {

constexpr int kAcceptedPerTurn = 16;

// A dead client is noticed after a minute of silence and three unanswered probes.
constexpr int kKeepAliveIdleSeconds = 60;
constexpr int kKeepAliveIntervalSeconds = 10;
constexpr int kKeepAliveProbes = 3;

// A client that acknowledges no bytes for this time is dead, too.
constexpr int kUserTimeoutMilliseconds = 30'000;

FileDescriptor OpenReserve() { return FileDescriptor(open("/dev/null", O_RDONLY | O_CLOEXEC)); }

void SetTcpOptions(int fd) {
  const auto set = [fd](int level, int name, int value) {
    setsockopt(fd, level, name, &value, sizeof(value));  // fails on unix: sockets, without harm
  };
  set(IPPROTO_TCP, TCP_NODELAY, 1);
  set(SOL_SOCKET, SO_KEEPALIVE, 1);
  set(IPPROTO_TCP, TCP_KEEPIDLE, kKeepAliveIdleSeconds);
  set(IPPROTO_TCP, TCP_KEEPINTVL, kKeepAliveIntervalSeconds);
  set(IPPROTO_TCP, TCP_KEEPCNT, kKeepAliveProbes);
  set(IPPROTO_TCP, TCP_USER_TIMEOUT, kUserTimeoutMilliseconds);
}

}  // namespace

Acceptor::Acceptor(FileDescriptor listener, Options options)
    : listener_(std::move(listener)),
      options_(std::move(options)),
      first_(*options_.hosts.front()),
      reserve_(OpenReserve()) {}

absl::Status Acceptor::Start() { return first_.events().Watch(listener_.get(), EPOLLIN, this); }

void Acceptor::Stop() {
  if (!listener_.valid()) return;
  first_.events().Unwatch(listener_.get());
  listener_.Close();
}

void Acceptor::OnReady(uint32_t /*events*/) {
  UnauthenticatedQueue& queue = first_.unauthenticated_queue();
  if (queue.MayRun()) return OnTurn();
  first_.events().ChangeWatch(listener_.get(), 0, this);
  queue.Wait(this);
}

void Acceptor::OnTurn() {
  first_.events().thread().AssertCurrent();
  if (!listener_.valid()) return;  // stopped meanwhile
  first_.events().ChangeWatch(listener_.get(), EPOLLIN, this);
  first_.unauthenticated_queue().Run([this] { AcceptSome(); });
}

void Acceptor::AcceptSome() {
  for (int i = 0; i < kAcceptedPerTurn && listener_.valid(); ++i) {
    sockaddr_storage peer = {};
    socklen_t size = sizeof(peer);
    FileDescriptor fd(accept4(listener_.get(), reinterpret_cast<sockaddr*>(&peer), &size,
                              SOCK_NONBLOCK | SOCK_CLOEXEC));
    if (fd.valid()) {
      Take(std::move(fd), OriginOf(peer));
    } else if (errno == EMFILE || errno == ENFILE) {
      return RefuseOne();
    } else if (errno != ECONNABORTED && errno != EINTR) {
      return;  // none is waiting
    }
  }
}

void Acceptor::Take(FileDescriptor fd, const ClientOrigin& origin) {
  SetTcpOptions(fd.get());
  ConnectionHost& host = *options_.hosts[next_host_++ % options_.hosts.size()];
  auto slot = options_.connections->Admit(origin, &host);
  if (slot == nullptr) {
    if (options_.tls == nullptr) {
      send(fd.get(), options_.refusal.data(), options_.refusal.size(), MSG_NOSIGNAL);
    }
    return;
  }
  auto socket = options_.tls == nullptr ? MakePlainSocket(std::move(fd))
                                        : MakeTlsSocket(std::move(fd), options_.tls);
  if (socket == nullptr) return;
  if (&host == &first_) return host.Adopt(std::move(socket), std::move(slot));
  // std::function needs a copyable function, so the parts travel in a shared one.
  struct Parts {
    std::unique_ptr<Socket> socket;
    std::unique_ptr<ConnectionSlot> slot;
  };
  auto parts = std::make_shared<Parts>(Parts{std::move(socket), std::move(slot)});
  host.events().Post(
      [&host, parts] { host.Adopt(std::move(parts->socket), std::move(parts->slot)); });
}

void Acceptor::RefuseOne() {
  options_.connections->DropUnauthenticated(ConnectionLimit::kFileDescriptors, 1);
  options_.connections->CountRefused(ConnectionLimit::kFileDescriptors);
  LogWarning("connection refused", {{"limit", ToString(ConnectionLimit::kFileDescriptors)}});
  reserve_.Close();
  FileDescriptor(accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC)).Close();
  reserve_ = OpenReserve();
}

}  // namespace spikeserve
