#include "tests/integration/http_client.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>

#include "absl/cleanup/cleanup.h"
#include "absl/status/status.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::StatusOr<HttpReply> HttpGet(const std::string& address, const std::string& path) {
  const size_t colon = address.rfind(':');
  int port = 0;
  sockaddr_in peer = {};
  peer.sin_family = AF_INET;
  if (colon == std::string::npos || !absl::SimpleAtoi(address.substr(colon + 1), &port) ||
      inet_pton(AF_INET, address.substr(0, colon).c_str(), &peer.sin_addr) != 1) {
    return absl::InvalidArgumentError(absl::StrCat("expected IPV4:PORT, received ", address));
  }
  peer.sin_port = htons(static_cast<uint16_t>(port));

  const int connection = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  const auto close_connection = absl::MakeCleanup([&] { close(connection); });
  if (connect(connection, reinterpret_cast<const sockaddr*>(&peer), sizeof(peer)) != 0) {
    return absl::ErrnoToStatus(errno, absl::StrCat("connect to ", address));
  }
  const std::string request =
      absl::StrCat("GET ", path, " HTTP/1.1\r\nHost: ", address, "\r\nConnection: close\r\n\r\n");
  if (send(connection, request.data(), request.size(), MSG_NOSIGNAL) < 0) {
    return absl::ErrnoToStatus(errno, "send");
  }
  std::string text;
  char block[16384];
  ssize_t length;
  while ((length = recv(connection, block, sizeof(block), 0)) > 0) {
    text.append(block, static_cast<size_t>(length));
  }

  const size_t head_end = text.find("\r\n\r\n");
  HttpReply reply;
  if (head_end == std::string::npos || text.size() < 12 ||
      !absl::SimpleAtoi(text.substr(9, 3), &reply.code)) {
    return absl::InternalError(absl::StrCat("not an HTTP reply: ", text));
  }
  reply.headers = text.substr(0, head_end);
  reply.body = text.substr(head_end + 4);
  return reply;
}

}  // namespace spikeserve
