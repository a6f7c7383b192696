#include "server/transport/acceptor.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/epoll.h>
#include <sys/socket.h>

#include <array>
#include <cerrno>
#include <utility>

#include "absl/strings/string_view.h"
#include "server/transport/socket.h"

namespace spikeserve {
namespace {

constexpr int kAcceptedPerTurn = 16;

// A dead client is noticed after a minute of silence and three unanswered probes.
constexpr int kKeepAliveIdleSeconds = 60;
constexpr int kKeepAliveIntervalSeconds = 10;
constexpr int kKeepAliveProbes = 3;

// An empty SETTINGS frame, and GOAWAY with ENHANCE_YOUR_CALM (RFC 9113, sections 6.5 and 6.8).
constexpr absl::string_view kRefusal(
    "\0\0\0\x04\0\0\0\0\0"
    "\0\0\x08\x07\0\0\0\0\0"
    "\0\0\0\0\0\0\0\x0b",
    26);

FileDescriptor OpenReserve() { return FileDescriptor(open("/dev/null", O_RDONLY | O_CLOEXEC)); }

// Returns the client's IP address; clients of a unix: socket share one name.
std::string ClientAddress(const sockaddr_storage& peer) {
  std::array<char, INET6_ADDRSTRLEN> text = {};
  if (peer.ss_family == AF_INET) {
    const auto& address = reinterpret_cast<const sockaddr_in&>(peer);
    inet_ntop(AF_INET, &address.sin_addr, text.data(), text.size());
  } else if (peer.ss_family == AF_INET6) {
    const auto& address = reinterpret_cast<const sockaddr_in6&>(peer);
    inet_ntop(AF_INET6, &address.sin6_addr, text.data(), text.size());
  } else {
    return "unix";
  }
  return text.data();
}

void SetTcpOptions(int fd) {
  const auto set = [fd](int level, int name, int value) {
    setsockopt(fd, level, name, &value, sizeof(value));  // fails on unix: sockets, without harm
  };
  set(IPPROTO_TCP, TCP_NODELAY, 1);
  set(SOL_SOCKET, SO_KEEPALIVE, 1);
  set(IPPROTO_TCP, TCP_KEEPIDLE, kKeepAliveIdleSeconds);
  set(IPPROTO_TCP, TCP_KEEPINTVL, kKeepAliveIntervalSeconds);
  set(IPPROTO_TCP, TCP_KEEPCNT, kKeepAliveProbes);
}

}  // namespace

Acceptor::Acceptor(FileDescriptor listener,
                   const std::vector<std::unique_ptr<TransportLoop>>* loops,
                   ConnectionTable* connections, const TransportLimits* limits, TlsContext* tls)
    : listener_(std::move(listener)),
      loops_(*loops),
      connections_(connections),
      limits_(*limits),
      tls_(tls),
      reserve_(OpenReserve()) {}

absl::Status Acceptor::Start() {
  return loops_.front()->events().Watch(listener_.get(), EPOLLIN, this);
}

void Acceptor::Stop() {
  if (!listener_.valid()) return;
  loops_.front()->events().Unwatch(listener_.get());
  listener_.Close();
}

void Acceptor::OnReady(uint32_t /*events*/) {
  StrangerQueue& queue = loops_.front()->stranger_queue();
  if (queue.MayRun()) return OnTurn();
  loops_.front()->events().ChangeWatch(listener_.get(), 0, this);
  queue.Wait(this);
}

void Acceptor::OnTurn() {
  if (!listener_.valid()) return;  // stopped meanwhile
  loops_.front()->events().ChangeWatch(listener_.get(), EPOLLIN, this);
  loops_.front()->stranger_queue().Run([this] { AcceptSome(); });
}

void Acceptor::AcceptSome() {
  for (int i = 0; i < kAcceptedPerTurn && listener_.valid(); ++i) {
    sockaddr_storage peer = {};
    socklen_t size = sizeof(peer);
    FileDescriptor fd(accept4(listener_.get(), reinterpret_cast<sockaddr*>(&peer), &size,
                              SOCK_NONBLOCK | SOCK_CLOEXEC));
    if (fd.valid()) {
      Take(std::move(fd), ClientAddress(peer));
    } else if (errno == EMFILE || errno == ENFILE) {
      return RefuseOne();
    } else if (errno != ECONNABORTED && errno != EINTR) {
      return;  // none is waiting
    }
  }
}

void Acceptor::Take(FileDescriptor fd, const std::string& address) {
  SetTcpOptions(fd.get());
  auto slot = connections_->Admit(address);
  if (slot == nullptr) {
    if (tls_ == nullptr) send(fd.get(), kRefusal.data(), kRefusal.size(), MSG_NOSIGNAL);
    return;
  }
  const bool crowded = connections_->strangers() > limits_.max_idle_strangers;
  std::shared_ptr<ssl_ctx_st> context = tls_ == nullptr ? nullptr : tls_->Get();
  auto socket = context == nullptr ? MakePlainSocket(std::move(fd))
                                   : MakeTlsSocket(std::move(fd), context.get());
  if (socket == nullptr) return;
  TransportLoop& loop = *loops_[next_loop_++ % loops_.size()];
  if (&loop == loops_.front().get()) {
    if (crowded) loop.CloseOldestStranger();
    return loop.Adopt(std::move(socket), std::move(slot));
  }
  // std::function needs a copyable function, so the parts travel in a shared one.
  struct Parts {
    std::unique_ptr<Socket> socket;
    std::unique_ptr<ConnectionSlot> slot;
  };
  auto parts = std::make_shared<Parts>(Parts{std::move(socket), std::move(slot)});
  loop.events().Post([&loop, crowded, parts] {
    if (crowded) loop.CloseOldestStranger();
    loop.Adopt(std::move(parts->socket), std::move(parts->slot));
  });
}

void Acceptor::RefuseOne() {
  loops_.front()->CloseOldestStranger();
  reserve_.Close();
  FileDescriptor(accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC)).Close();
  reserve_ = OpenReserve();
}

}  // namespace spikeserve
