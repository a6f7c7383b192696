// Frames to the gRPC port: whatever a client sends, the connection ends in order.
#include <sys/epoll.h>

#include <functional>
#include <utility>

#include "server/transport/connection.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/fuzz/memory_socket.h"
#include "tests/support/fake_clock.h"

namespace spikeserve {
namespace {

constexpr size_t kMessageLimit = 4096;  // bytes

// Accepts every message, and ends the call after the last one.
class Sink final : public CallHandler {
 public:
  Sink(Call* call, int* open) : call_(*call), open_(*open) { ++open_; }

  size_t message_limit() const override { return kMessageLimit; }
  void OnMessage(absl::string_view message) override {
    FUZZ_CHECK(message.size() <= kMessageLimit);
  }
  void OnTooLong(size_t length) override {
    FUZZ_CHECK(length > kMessageLimit);
    call_.Finish(absl::ResourceExhaustedError("too long"));
  }
  void OnHalfClose() override { call_.Finish(absl::OkStatus()); }
  void OnClosed() override { --open_; }
  void OnDrain() override {}

 private:
  Call& call_;
  int& open_;
};

class Router final : public CallRouter {
 public:
  std::shared_ptr<CallHandler> Route(Call* call) override {
    return std::make_shared<Sink>(call, &open_);
  }
  int open() const { return open_; }

 private:
  int open_ = 0;
};

// Runs what was posted to the loop.
void RunTurn(EventLoop* loop) {
  loop->Post([loop] { loop->Stop(); });
  loop->Run();
}

std::string Frame(char type, char flags, char stream, absl::string_view payload) {
  std::string frame = {0, static_cast<char>(payload.size() >> 8),
                       static_cast<char>(payload.size())};
  frame += type;
  frame += flags;
  frame += std::string(3, '\0') + stream;
  return frame.append(payload.data(), payload.size());
}

}  // namespace

void FuzzOne(absl::string_view input) {
  InputReader reader(input);
  const size_t piece = size_t{reader.Byte()} * 16;
  const FakeClock clock;
  const auto loop = *EventLoop::Create(&clock);
  const TransportLimits limits;
  ConnectionTable table(
      {.connections = 1, .per_address = 1, .per_network = 1, .idle_unauthenticated = 1});
  TransportBudgets budgets;
  NoCloser closer;
  Router router;
  std::string answer;
  bool closed = false;
  Connection::Shared shared = {.loop = loop.get(),
                               .clock = &clock,
                               .router = &router,
                               .limits = &limits,
                               .budgets = &budgets,
                               .closed = [&](Connection*) { closed = true; },
                               .unauthenticated_queue = UnauthenticatedQueue(loop.get(), &clock)};
  {
    Connection connection(std::make_unique<MemorySocket>(reader.rest(), piece, &answer),
                          table.Admit(OneClient(), &closer), &shared);
    FUZZ_CHECK(connection.Start().ok());
    while (!closed) {
      connection.OnReady(EPOLLIN);
      for (Connection* waiting : std::exchange(shared.to_flush, {})) waiting->Flush();
    }
    RunTurn(loop.get());
  }
  FUZZ_CHECK(router.open() == 0);
  FUZZ_CHECK(budgets.all.used() == 0);
  FUZZ_CHECK(budgets.unauthenticated.used() == 0);
}

std::vector<std::string> Seeds() {
  const std::string preface = "\x40PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + Frame(4, 0, 0, "");
  // HPACK: POST, http, and literals without indexing.
  const auto literal = [](absl::string_view name, absl::string_view value) {
    return std::string{0, static_cast<char>(name.size())} + std::string(name) +
           static_cast<char>(value.size()) + std::string(value);
  };
  const std::string headers =
      std::string("\x83\x86") + literal(":path", "/spikeserve.v1.PolicyService/Act") +
      literal(":authority", "x") + literal("te", "trailers") +
      literal("content-type", "application/grpc") + literal("grpc-timeout", "5S");
  const std::string message("\0\0\0\0\5hello", 10);
  return {preface + Frame(1, 4, 1, headers) + Frame(0, 1, 1, message),
          preface + Frame(1, 0, 1, headers.substr(0, 20)) + Frame(9, 4, 1, headers.substr(20)) +
              Frame(0, 0, 1, message) + Frame(3, 0, 1, std::string(4, '\x08')),
          preface + Frame(6, 0, 0, "12345678") + Frame(8, 0, 0, std::string("\0\0\1\0", 4)) +
              Frame(2, 0, 3, std::string("\0\0\0\1\x10", 5)) +
              Frame(7, 0, 0, std::string(8, '\0'))};
}

}  // namespace spikeserve
