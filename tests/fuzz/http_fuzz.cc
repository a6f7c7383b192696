// Requests to the HTTP port: whatever a client sends, it gets one answer or none.
#include <sys/epoll.h>

#include "absl/strings/match.h"
#include "server/web/http_connection.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/fuzz/memory_socket.h"
#include "tests/fuzz/one_client.h"
#include "tests/support/fake_clock.h"

namespace spikeserve {
namespace {

class Owner final : public HttpConnection::Owner {
 public:
  explicit Owner(EventLoop* loop) : loop_(*loop) {}

  EventLoop& events() override { return loop_; }
  void OnRequest(HttpConnection* connection, HttpRequest request) override {
    FUZZ_CHECK(request.path.front() == '/');
    connection->Answer({.body = request.path});
  }
  void OnClosed(HttpConnection* /*connection*/) override { closed_ = true; }
  bool closed() const { return closed_; }

 private:
  EventLoop& loop_;
  bool closed_ = false;
};

}  // namespace

void FuzzOne(absl::string_view input) {
  InputReader reader(input);
  const size_t piece = size_t{reader.Byte()} * 16;
  const FakeClock clock;
  const auto loop = *EventLoop::Create(&clock);
  ConnectionTable table(
      {.connections = 1, .per_address = 1, .per_network = 1, .idle_strangers = 1});
  NoCloser closer;
  std::string answer;
  Owner owner(loop.get());
  HttpConnection connection(std::make_unique<MemorySocket>(reader.rest(), piece, &answer),
                            table.Admit(OneClient(), &closer), /*local_names_only=*/true, &owner);
  FUZZ_CHECK(connection.Start().ok());
  while (!owner.closed()) connection.OnReady(EPOLLIN);
  if (!answer.empty()) FUZZ_CHECK(absl::StartsWith(answer, "HTTP/1.1 "));
}

std::vector<std::string> Seeds() {
  return {
      "\x40GET /sessions.json?sort=steps&order=%64esc HTTP/1.1\r\nHost: localhost\r\n\r\n",
      "\x01HEAD / HTTP/1.0\r\nAuthorization: Basic eDp5\r\nRange: bytes=0-1,2-3\r\n\r\n",
      "\x02POST /explain.json HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n"};
}

}  // namespace spikeserve
