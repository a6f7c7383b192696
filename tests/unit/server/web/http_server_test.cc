#include "server/web/http_server.h"

#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <memory>
#include <string>
#include <utility>

#include "absl/synchronization/notification.h"
#include "core/base/clock.h"
#include "server/base/file_descriptor.h"

namespace spikeserve {
namespace {

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
  const FileDescriptor client(socket(AF_INET, SOCK_STREAM, 0));
  sockaddr_in address = {};
  address.sin_family = AF_INET;
  address.sin_port = htons(static_cast<uint16_t>((*server)->address().port));
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  ASSERT_EQ(connect(client.get(), reinterpret_cast<sockaddr*>(&address), sizeof(address)), 0);
  const std::string request = "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n";
  ASSERT_EQ(send(client.get(), request.data(), request.size(), 0),
            static_cast<ssize_t>(request.size()));
  asked.WaitForNotification();
  server->reset();
  char byte;
  EXPECT_EQ(recv(client.get(), &byte, 1, MSG_DONTWAIT), 0);  // the end, and not EAGAIN
  done({});                                                  // nobody waits for it
}

}  // namespace
}  // namespace spikeserve
