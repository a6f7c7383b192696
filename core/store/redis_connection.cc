#include "core/store/redis_connection.h"

#include <sys/socket.h>

#include <array>
#include <cerrno>
#include <cstring>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr size_t kReadBytes = 16 << 10;

}  // namespace

std::string FormatRedisCommand(absl::Span<const absl::string_view> arguments) {
  absl::InlinedVector<const char*, 8> values;
  absl::InlinedVector<size_t, 8> sizes;
  for (const absl::string_view argument : arguments) {
    values.push_back(argument.data());
    sizes.push_back(argument.size());
  }
  char* formatted = nullptr;
  const int size = redisFormatCommandArgv(&formatted, static_cast<int>(values.size()),
                                          values.data(), sizes.data());
  std::string command(formatted, size > 0 ? static_cast<size_t>(size) : 0);
  redisFreeCommand(formatted);
  return command;
}

absl::string_view TextOf(const redisReply& reply) {
  return reply.str == nullptr ? absl::string_view() : absl::string_view(reply.str, reply.len);
}

absl::Status RedisStatus(const redisReply& reply) {
  if (reply.type != REDIS_REPLY_ERROR) return absl::OkStatus();
  return absl::UnavailableError(absl::StrCat("session store: ", TextOf(reply)));
}

absl::StatusOr<std::unique_ptr<RedisConnection>> RedisConnection::Connect(
    const RedisEndpoint& endpoint, const RedisOptions& options) {
  const timeval timeout = absl::ToTimeval(kTimeout);
  auto connection = std::unique_ptr<RedisConnection>(new RedisConnection(
      endpoint, redisConnectWithTimeout(endpoint.host.c_str(), endpoint.port, timeout)));
  redisContext* context = connection->context_.get();
  if (context == nullptr || context->err != 0) {
    return absl::UnavailableError(absl::StrCat("session store: cannot connect to ",
                                               endpoint.ToString(), ": ",
                                               context == nullptr ? "no memory" : context->errstr));
  }
  redisSetTimeout(context, timeout);
  redisEnableKeepAlive(context);
  if (options.address.tls) {
    auto tls = ConnectTls(context->fd, endpoint.host, options.tls_files);
    if (!tls.ok()) {
      return absl::UnavailableError(absl::StrCat("session store: no TLS with ", endpoint.ToString(),
                                                 ": ", tls.status().message()));
    }
    connection->tls_ = *std::move(tls);
  }
  if (auto status = connection->Authenticate(options); !status.ok()) return status;
  return connection;
}

absl::Status RedisConnection::Authenticate(const RedisOptions& options) {
  if (options.password.empty()) return absl::OkStatus();
  const auto reply = Run({"AUTH", options.password});
  // Sentinels often have no password, although the Redis servers have one.
  const bool needless = !options.address.primary.empty() &&
                        absl::StrContains(reply.status().message(), "any password configured");
  return needless ? absl::OkStatus() : reply.status();
}

absl::StatusOr<RedisReply> RedisConnection::Run(absl::Span<const absl::string_view> arguments) {
  Append(FormatRedisCommand(arguments));
  auto reply = Read();
  if (!reply.ok()) return reply;
  if (auto status = RedisStatus(**reply); !status.ok()) return status;
  return reply;
}

absl::StatusOr<RedisReply> RedisConnection::Read() {
  void* raw = nullptr;
  if (redisReaderGetReply(context_->reader, &raw) != REDIS_OK) {
    return Failed(context_->reader->errstr);
  }
  if (raw == nullptr && !unsent_.empty()) {
    if (auto status = SendAll(); !status.ok()) return status;
  }
  while (raw == nullptr) {
    if (auto status = Receive(); !status.ok()) return status;
    if (redisReaderGetReply(context_->reader, &raw) != REDIS_OK) {
      return Failed(context_->reader->errstr);
    }
  }
  return RedisReply(static_cast<redisReply*>(raw));
}

absl::Status RedisConnection::SendAll() {
  size_t sent = 0;
  while (sent < unsent_.size()) {
    const char* from = unsent_.data() + sent;
    size_t count = unsent_.size() - sent;
    if (tls_ != nullptr) {
      if (SSL_write_ex(tls_.get(), from, count, &count) != 1) {
        return Failed(TakeTlsErrorOfWrite(tls_.get()));
      }
    } else {
      const ssize_t written = send(context_->fd, from, count, MSG_NOSIGNAL);
      if (written < 0 && errno == EINTR) continue;
      if (written < 0) return Failed(std::strerror(errno));
      count = static_cast<size_t>(written);
    }
    sent += count;
  }
  unsent_.clear();
  return absl::OkStatus();
}

absl::Status RedisConnection::Receive() {
  std::array<char, kReadBytes> bytes;
  size_t count = 0;
  if (tls_ != nullptr) {
    if (SSL_read_ex(tls_.get(), bytes.data(), bytes.size(), &count) != 1) {
      return Failed(TakeTlsError());
    }
  } else {
    ssize_t received = 0;
    do {
      received = recv(context_->fd, bytes.data(), bytes.size(), 0);
    } while (received < 0 && errno == EINTR);
    if (received == 0) return Failed("the connection was closed");
    if (received < 0) return Failed(std::strerror(errno));
    count = static_cast<size_t>(received);
  }
  redisReaderFeed(context_->reader, bytes.data(), count);
  return absl::OkStatus();
}

absl::Status RedisConnection::Failed(absl::string_view what) const {
  return absl::UnavailableError(absl::StrCat("session store: ", endpoint_.ToString(), ": ", what));
}

}  // namespace spikeserve
