#include "core/store/redis_connection.h"

#include <sys/socket.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/strings/escaping.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

constexpr size_t kReadBytes = 16 << 10;

// As much of what a server sends that is no Redis as an error quotes.
constexpr size_t kQuotedBytes = 60;

// As hiredis reads replies, but an array may have only as many elements as a counter of the
// connection leaves: hiredis allocates them before the first one has arrived.
redisReplyObjectFunctions* BoundedReplies() {
  static redisReplyObjectFunctions* const functions = [] {
    redisReader* const reader = redisReaderCreate();
    static const redisReplyObjectFunctions standard = *reader->fn;
    redisReaderFree(reader);
    auto* bounded = new redisReplyObjectFunctions(standard);
    // The number is an int in hiredis 0 and a size_t in hiredis 1.
    bounded->createArray = [](const redisReadTask* task, auto elements) -> void* {
      auto* const left = static_cast<size_t*>(task->privdata);
      if (std::cmp_less(elements, 0) || std::cmp_greater(elements, *left)) return nullptr;
      *left -= static_cast<size_t>(elements);
      return standard.createArray(task, elements);
    };
    return bounded;
  }();
  return functions;
}

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

absl::Status UnexpectedReply(absl::string_view expected) {
  return absl::UnavailableError(absl::StrCat("session store: expected ", expected));
}

absl::Status RedisStatus(const redisReply& reply) {
  if (reply.type != REDIS_REPLY_ERROR) return absl::OkStatus();
  return absl::UnavailableError(absl::StrCat("session store: ", TextOf(reply)));
}

absl::StatusOr<std::unique_ptr<RedisConnection>> RedisConnection::Connect(
    const RedisEndpoint& endpoint, const RedisOptions& options, RedisPeer peer) {
  const timeval timeout = absl::ToTimeval(options.timeout);
  auto connection = std::unique_ptr<RedisConnection>(
      new RedisConnection(endpoint, options.timeout,
                          redisConnectWithTimeout(endpoint.host.c_str(), endpoint.port, timeout)));
  redisContext* context = connection->context_.get();
  if (context == nullptr || context->err != 0) {
    return absl::UnavailableError(absl::StrCat("session store: cannot connect to ",
                                               endpoint.ToString(), ": ",
                                               context == nullptr ? "no memory" : context->errstr));
  }
  redisSetTimeout(context, timeout);
  redisEnableKeepAlive(context);
  context->reader->fn = BoundedReplies();
  context->reader->privdata = &connection->elements_left_;
  if (options.address.tls) {
    auto tls = ConnectTls(context->fd, endpoint.host, options.tls_files);
    if (!tls.ok()) {
      return absl::UnavailableError(absl::StrCat("session store: no TLS with ", endpoint.ToString(),
                                                 ": ", tls.status().message()));
    }
    connection->tls_ = *std::move(tls);
  }
  RETURN_IF_ERROR(connection->Authenticate(options, peer));
  return connection;
}

absl::Status RedisConnection::Authenticate(const RedisOptions& options, RedisPeer peer) {
  const std::string& user = options.address.user;
  const auto password = ReadRedisPassword(options.password_file);
  if (!password.ok()) return absl::UnavailableError(password.status().message());
  if (password->empty() && user.empty()) return absl::OkStatus();
  const auto reply = user.empty() ? Run({"AUTH", *password}) : Run({"AUTH", user, *password});
  if (reply.ok() || peer == RedisPeer::kRedis) return reply.status();
  // Sentinels often have neither password nor user, although the Redis servers have them.
  const absl::string_view error = reply.status().message();
  const bool needless = absl::StrContains(error, "any password configured") ||
                        (!user.empty() && absl::StrContains(error, "WRONGPASS"));
  return needless ? absl::OkStatus() : reply.status();
}

absl::StatusOr<RedisReply> RedisConnection::Run(absl::Span<const absl::string_view> arguments) {
  Append(FormatRedisCommand(arguments));
  auto reply = Read();
  if (!reply.ok()) return reply;
  RETURN_IF_ERROR(RedisStatus(**reply));
  return reply;
}

absl::StatusOr<RedisReply> RedisConnection::Read() {
  if (!failure_.ok()) return failure_;
  auto reply = ReadNext();
  failure_ = reply.status();
  return reply;
}

absl::StatusOr<RedisReply> RedisConnection::ReadNext() {
  elements_left_ = kMostReplyElements;
  reply_bytes_ = 0;
  auto reply = Parse();
  if (!reply.ok() || *reply != nullptr) return reply;
  RETURN_IF_ERROR(SendAll());
  const SteadyClock clock;
  const absl::Duration end = clock.Now() + kTimeoutsOfReply * timeout_;
  while (reply.ok() && *reply == nullptr) {
    RETURN_IF_ERROR(Receive());
    if (reply_bytes_ > kMostReplyBytes) return Failed("a reply is too large");
    reply = Parse();
    if (reply.ok() && *reply == nullptr && clock.Now() > end) {
      return Failed("a reply has not arrived in time");
    }
  }
  return reply;
}

absl::StatusOr<RedisReply> RedisConnection::Parse() {
  void* raw = nullptr;
  if (redisReaderGetReply(context_->reader, &raw) != REDIS_OK) return ReaderFailed();
  if (raw != nullptr) has_replied_ = true;
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
  if (!has_replied_ && first_bytes_.size() < kQuotedBytes) {
    first_bytes_.append(bytes.data(), std::min(count, kQuotedBytes - first_bytes_.size()));
  }
  reply_bytes_ += count;
  redisReaderFeed(context_->reader, bytes.data(), count);
  return absl::OkStatus();
}

absl::Status RedisConnection::Failed(absl::string_view what) const {
  return absl::UnavailableError(absl::StrCat("session store: ", endpoint_.ToString(), ": ", what));
}

absl::Status RedisConnection::ReaderFailed() const {
  const redisReader& reader = *context_->reader;
  if (reader.err == REDIS_ERR_OOM) return Failed("a reply is too large");
  if (has_replied_ || reader.err != REDIS_ERR_PROTOCOL) return Failed(reader.errstr);
  const absl::string_view line = first_bytes_;
  return absl::UnavailableError(absl::StrCat(
      "--session_store: expected a Redis server at ", endpoint_.ToString(), ", received \"",
      absl::CHexEscape(line.substr(0, line.find_first_of("\r\n"))), "\""));
}

}  // namespace spikeserve
