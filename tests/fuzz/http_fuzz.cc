// Requests to the HTTP port: whatever a client sends, it gets one answer or none.
#include <sys/epoll.h>

#include <variant>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/hex.h"
#include "server/web/http_connection.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/fuzz/memory_socket.h"
#include "tests/support/fake_clock.h"

namespace spikeserve {
namespace {

constexpr size_t kLongestBody = 64;
constexpr int64_t kMost = 1 << 20;

class Owner final : public HttpConnection::Owner {
 public:
  explicit Owner(EventLoop* loop) : loop_(*loop) {}

  EventLoop& events() override { return loop_; }
  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) override {
    FUZZ_CHECK(request.is_post && request.body.empty());
    if (request.path == "/refused") return HttpResponse{.code = 405, .body = "no"};
    return AcceptedBody{
        .longest = kLongestBody,
        .caller = nullptr,
        .held = std::make_shared<HeldBytes>(HeldBytes::Budget{bytes_, kMost}, HeldBytes::Budget{})};
  }
  void OnRequest(HttpConnection* connection, HttpRequest request) override {
    FUZZ_CHECK(request.path.front() == '/');
    const size_t longest = kLongestBody + (request.is_gzip ? size_t{kGzipOverhead} : 0);
    FUZZ_CHECK(request.body.size() <= (request.is_post ? longest : 0));
    TakeBody(&request).status().IgnoreError();
    connection->Answer({.body = request.path});
  }
  void OnClosed(HttpConnection* /*connection*/) override { closed_ = true; }
  bool closed() const { return closed_; }
  int64_t body_bytes() const { return bytes_->used(); }

 private:
  EventLoop& loop_;
  bool closed_ = false;
  const std::shared_ptr<ByteBudget> bytes_ = std::make_shared<ByteBudget>();
};

}  // namespace

void FuzzOne(absl::string_view input) {
  InputReader reader(input);
  const size_t piece = size_t{reader.Byte()} * 16;
  const FakeClock clock;
  const auto loop = *EventLoop::Create(&clock);
  ConnectionTable table(
      {.connections = 1, .per_address = 1, .per_network = 1, .idle_unauthenticated = 1});
  NoCloser closer;
  std::string answer;
  Owner owner(loop.get());
  HttpOptions options;
  options.local_names_only = true;
  options.origins = *Origins::Parse("", "http://a.example");
  HttpConnection connection(std::make_unique<MemorySocket>(reader.rest(), piece, &answer),
                            table.Admit(OneClient(), &closer), options, &owner);
  FUZZ_CHECK(connection.Start().ok());
  while (!owner.closed()) connection.OnReady(EPOLLIN);
  FUZZ_CHECK(owner.body_bytes() == 0);
  if (!answer.empty()) FUZZ_CHECK(absl::StartsWith(answer, "HTTP/1.1 "));
}

std::vector<std::string> Seeds() {
  return {
      "\x40GET /sessions.json?sort=steps&order=%64esc HTTP/1.1\r\nHost: localhost\r\n\r\n",
      "\x01HEAD / HTTP/1.0\r\nAuthorization: Basic eDp5\r\nRange: bytes=0-1,2-3\r\n\r\n",
      "\x02POST /explain.json HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n",
      "\x02POST /v2/models/a/infer HTTP/1.1\r\nExpect: 100-continue\r\nContent-Length: "
      "7\r\n\r\n{\"a\":1}",
      "\x40POST /v2 HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n2;a=b\r\n{}\r\n0\r\nA: b\r\n\r\n",
      "\x40GET http://localhost:1/healthz?a HTTP/1.1\r\nHost: localhost\r\n\r\n",
      "\x01POST /refused HTTP/1.1\r\nContent-Length: 999999999999\r\n\r\n{}",
      "\x03OPTIONS /v2 HTTP/1.1\r\nOrigin: http://a.example\r\nAccess-Control-Request-Method: "
      "POST\r\n\r\n",
      absl::StrCat("\x03POST /v2 HTTP/1.1\r\nOrigin: http://a.example\r\nContent-Encoding: gzip\r\n"
                   "Content-Length: 23\r\n\r\n",
                   *ParseHex("1f8b08000000000002034b4c4a0600c241243503000000"))};
}

}  // namespace spikeserve
