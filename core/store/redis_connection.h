// A connection to one Redis server, in plain text or over TLS. Uses the protocol of hiredis.
//
//   auto connection = RedisConnection::Connect(endpoint, options);
//   (*connection)->Append(FormatRedisCommand({"RPUSHX", key, value}));
//   auto reply = (*connection)->Read();
//
// Commands are sent together when the first reply is read. Each command has one reply, in order.
// Not thread-safe; Connect() and Read() block for at most kTimeout.
#ifndef CORE_STORE_REDIS_CONNECTION_H_
#define CORE_STORE_REDIS_CONNECTION_H_

#include <hiredis/hiredis.h>

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/store/redis_options.h"
#include "core/store/redis_tls.h"

namespace spikeserve {

struct RedisReplyDeleter {
  void operator()(redisReply* reply) const { freeReplyObject(reply); }
};
using RedisReply = std::unique_ptr<redisReply, RedisReplyDeleter>;

// Returns a command in the form in which it is sent.
std::string FormatRedisCommand(absl::Span<const absl::string_view> arguments);

// Returns the text of a reply; empty unless it is a string, a status or an error.
absl::string_view TextOf(const redisReply& reply);

// Returns OK, or UNAVAILABLE with the text of an error reply.
absl::Status RedisStatus(const redisReply& reply);

class RedisConnection {
 public:
  static constexpr absl::Duration kTimeout = absl::Seconds(1);

  // Connects and authenticates. Returns UNAVAILABLE if it cannot.
  static absl::StatusOr<std::unique_ptr<RedisConnection>> Connect(const RedisEndpoint& endpoint,
                                                                  const RedisOptions& options);

  const RedisEndpoint& endpoint() const { return endpoint_; }

  // Takes a command of FormatRedisCommand().
  void Append(absl::string_view command) { unsent_.append(command.data(), command.size()); }

  // Returns the reply to the oldest command without one, which may be an error. Returns UNAVAILABLE
  // if the server does not answer; the connection is of no further use then.
  absl::StatusOr<RedisReply> Read();

  // Runs one command. Returns UNAVAILABLE also if the reply is an error.
  absl::StatusOr<RedisReply> Run(absl::Span<const absl::string_view> arguments);

 private:
  struct ContextDeleter {
    void operator()(redisContext* context) const { redisFree(context); }
  };
  RedisConnection(RedisEndpoint endpoint, redisContext* context)
      : endpoint_(std::move(endpoint)), context_(context) {}

  absl::Status Authenticate(const RedisOptions& options);
  absl::Status SendAll();
  // Reads what has arrived, and waits if it is nothing.
  absl::Status Receive();
  absl::Status Failed(absl::string_view what) const;

  const RedisEndpoint endpoint_;
  const std::unique_ptr<redisContext, ContextDeleter> context_;  // owns the socket and the reader
  SslConnection tls_;                                            // null: plain text
  std::string unsent_;
};

}  // namespace spikeserve

#endif  // CORE_STORE_REDIS_CONNECTION_H_
