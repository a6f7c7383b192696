#include "server/transport/transport.h"

#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <utility>

#include "absl/strings/string_view.h"
#include "absl/synchronization/blocking_counter.h"
#include "absl/time/clock.h"
#include "core/base/status_macros.h"
#include "core/base/steady_wait.h"
#include "server/transport/listener.h"

namespace spikeserve {
namespace {

// File descriptors that are not connections of gRPC: policies, recordings, the status page.
constexpr int64_t kOtherDescriptors = 384;

// An empty SETTINGS frame, and GOAWAY with ENHANCE_YOUR_CALM (RFC 9113, sections 6.5 and 6.8).
constexpr absl::string_view kRefusal(
    "\0\0\0\x04\0\0\0\0\0"
    "\0\0\x08\x07\0\0\0\0\0"
    "\0\0\0\0\0\0\0\x0b",
    26);

constexpr absl::Duration kStopPollInterval = absl::Milliseconds(5);

// Raises the limit on open files as far as the system lets the process, and returns how many
// connections fit.
int64_t ConnectionsThatFit(int64_t wanted) {
  rlimit files = {};
  if (getrlimit(RLIMIT_NOFILE, &files) != 0) return wanted;
  const auto needed = static_cast<rlim_t>(wanted + kOtherDescriptors);
  if (files.rlim_cur < needed) {
    files.rlim_cur = std::min(needed, files.rlim_max);
    setrlimit(RLIMIT_NOFILE, &files);
    getrlimit(RLIMIT_NOFILE, &files);
  }
  const auto available = static_cast<int64_t>(std::min<rlim_t>(files.rlim_cur, needed));
  return std::min(wanted, std::max<int64_t>(available - kOtherDescriptors, available / 2));
}

}  // namespace

Transport::Transport(const TransportOptions& options)
    : options_(options),
      connections_({.connections = ConnectionsThatFit(options.limits.max_connections),
                    .per_address = options.limits.max_connections_per_address,
                    .per_network = options.limits.max_connections_per_network,
                    .idle_unauthenticated = options.limits.max_idle_unauthenticated}) {}

absl::StatusOr<std::unique_ptr<Transport>> Transport::Create(const TransportOptions& options) {
  auto transport = std::unique_ptr<Transport>(new Transport(options));
  for (int i = 0; i < options.loops; ++i) {
    ASSIGN_OR_RETURN(auto loop, TransportLoop::Create(&transport->options_.limits,
                                                      &transport->budgets_, options.clock));
    transport->loops_.push_back(std::move(loop));
  }
  ASSIGN_OR_RETURN(auto listeners, Listen("--listen", options.listen));
  transport->address_ = listeners.address;
  Acceptor::Options accepting = {.hosts = {},
                                 .connections = &transport->connections_,
                                 .refusal = kRefusal,
                                 .tls = options.tls};
  for (const auto& loop : transport->loops_) accepting.hosts.push_back(loop.get());
  for (FileDescriptor& listener : listeners.sockets) {
    transport->acceptors_.push_back(std::make_unique<Acceptor>(std::move(listener), accepting));
  }
  if (options.datagram_listen.has_value()) {
    ASSIGN_OR_RETURN(auto datagrams,
                     ListenToDatagrams("--datagram_listen", *options.datagram_listen));
    transport->datagram_address_ = datagrams.address;
    transport->datagrams_ = std::move(datagrams.sockets.front());
    for (const auto& loop : transport->loops_) loop->AddDatagrams(transport->datagrams_.get());
  }
  return transport;
}

Transport::~Transport() { Stop(absl::ZeroDuration()); }

absl::Status Transport::Start() {
  for (const auto& acceptor : acceptors_) {
    RETURN_IF_ERROR(acceptor->Start());
  }
  for (const auto& loop : loops_) loop->Run();
  running_ = true;
  return absl::OkStatus();
}

bool Transport::RunOnAll(std::function<void(TransportLoop&)> work, absl::Duration timeout) {
  auto shared_work = std::make_shared<std::function<void(TransportLoop&)>>(std::move(work));
  auto done = std::make_shared<SteadyNotification>();
  auto waiting = std::make_shared<std::atomic<size_t>>(loops_.size());
  for (const auto& loop : loops_) {
    loop->events().Post([shared_work, done, waiting, target = loop.get()] {
      (*shared_work)(*target);
      if (waiting->fetch_sub(1) == 1) done->Notify();
    });
  }
  return done->WaitFor(timeout);
}

void Transport::Drain() {
  if (!running_) return;
  RunOnAll([](TransportLoop& loop) { loop.Drain(); }, absl::InfiniteDuration());
}

bool Transport::Responds(absl::Duration timeout) {
  return RunOnAll([](TransportLoop&) {}, timeout);
}

void Transport::Stop(absl::Duration timeout) {
  if (!std::exchange(running_, false)) return;
  const absl::Duration end = options_.clock->Now() + timeout;
  RunOnAll(
      [this](TransportLoop& loop) {
        if (&loop == loops_.front().get()) {
          for (const auto& acceptor : acceptors_) acceptor->Stop();
        }
        loop.GoAway();
      },
      absl::InfiniteDuration());
  while (connections_.counts().open > 0 && options_.clock->Now() < end) {
    absl::SleepFor(kStopPollInterval);
  }
  for (const auto& loop : loops_) loop->Join();
  if (address_.is_unix()) unlink(address_.unix_path.c_str());
}

}  // namespace spikeserve
