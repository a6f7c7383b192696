#include "server/web/http_server.h"

#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <atomic>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/synchronization/notification.h"
#include "core/base/clock.h"
#include "server/base/file_descriptor.h"

namespace spikeserve {
namespace {

// Connects to the server and sends GET /.
FileDescriptor Ask(const HttpServer& server) {
  FileDescriptor client(socket(AF_INET, SOCK_STREAM, 0));
  sockaddr_in address = {};
  address.sin_family = AF_INET;
  address.sin_port = htons(static_cast<uint16_t>(server.address().port));
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  EXPECT_EQ(connect(client.get(), reinterpret_cast<sockaddr*>(&address), sizeof(address)), 0);
  const std::string request = "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n";
  EXPECT_EQ(send(client.get(), request.data(), request.size(), 0),
            static_cast<ssize_t>(request.size()));
  return client;
}

// Reads until `bytes` have arrived or the connection ends. Returns what arrived.
std::string ReadAtLeast(const FileDescriptor& client, size_t bytes) {
  std::string received;
  std::string buffer(1 << 16, '\0');
  while (received.size() < bytes) {
    const ssize_t n = recv(client.get(), buffer.data(), buffer.size(), 0);
    if (n <= 0) break;
    received.append(buffer, 0, static_cast<size_t>(n));
  }
  return received;
}

// Gives `most` pieces of a size. Counts them, and tells when it is destroyed.
class Pieces final : public HttpFeed {
 public:
  struct Seen {
    std::atomic<int> given = 0;
    absl::Notification gone;
  };
  Pieces(size_t size, int most, Seen* seen) : size_(size), most_(most), seen_(seen) {}
  ~Pieces() override { seen_->gone.Notify(); }
  std::optional<std::string> Next() override {
    if (seen_->given == most_) return std::nullopt;
    ++seen_->given;
    return std::string(size_, 'x');
  }

 private:
  const size_t size_;
  const int most_;
  Seen* const seen_;
};

// Starts a server that answers the first request with a feed, and the others without.
std::unique_ptr<HttpServer> StartFeeding(const Clock& clock, size_t size, int most,
                                         Pieces::Seen* seen) {
  auto server = HttpServer::Start(
      {.listen = {.host = "127.0.0.1", .port = 0}, .clock = &clock},
      [=, first = std::make_shared<std::atomic<bool>>(true)](const HttpRequest& /*request*/,
                                                             const HttpServer::Done& done) {
        done({.body = "begin\n",
              .feed =
                  first->exchange(false) ? std::make_shared<Pieces>(size, most, seen) : nullptr});
      });
  EXPECT_TRUE(server.ok()) << server.status();
  return *std::move(server);
}

constexpr int kEndless = 1 << 30;

// A slow client makes no queue: the next piece is not made before it has taken the last one.
TEST(HttpServerTest, AFeedWaitsForItsClient) {
  const SteadyClock clock;
  Pieces::Seen seen;
  constexpr size_t kSize = 64 << 20;  // more than the system's buffers of both ends
  const auto server = StartFeeding(clock, kSize, kEndless, &seen);
  const FileDescriptor client = Ask(*server);
  ReadAtLeast(client, 1000);
  // The loop turns, and asks the feed if it does so at all, while other clients come and go.
  for (int i = 0; i < 20; ++i) ReadAtLeast(Ask(*server), kEndless);
  EXPECT_EQ(seen.given, 1);
}

TEST(HttpServerTest, AFeedEndsWithItsClient) {
  const SteadyClock clock;
  Pieces::Seen seen;
  const auto server = StartFeeding(clock, 0, kEndless, &seen);
  { ReadAtLeast(Ask(*server), 6); }
  seen.gone.WaitForNotification();
}

TEST(HttpServerTest, AFeedEndsWithTheServer) {
  const SteadyClock clock;
  Pieces::Seen seen;
  auto server = StartFeeding(clock, 0, kEndless, &seen);
  const FileDescriptor client = Ask(*server);
  ReadAtLeast(client, 6);
  server.reset();
  EXPECT_TRUE(seen.gone.HasBeenNotified());
}

TEST(HttpServerTest, ConnectionsEndWithTheServerWhileAPageIsBeingMade) {
  const SteadyClock clock;
  HttpServer::Done done;
  absl::Notification asked;
  auto server = HttpServer::Start({.listen = {.host = "127.0.0.1", .port = 0}, .clock = &clock},
                                  [&](const HttpRequest& /*request*/, HttpServer::Done answer) {
                                    done = std::move(answer);
                                    asked.Notify();
                                  });
  ASSERT_TRUE(server.ok()) << server.status();
  const FileDescriptor client = Ask(**server);
  asked.WaitForNotification();
  server->reset();
  char byte;
  EXPECT_EQ(recv(client.get(), &byte, 1, MSG_DONTWAIT), 0);  // the end, and not EAGAIN
  done({});                                                  // nobody waits for it
}

}  // namespace
}  // namespace spikeserve
