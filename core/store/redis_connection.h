// A connection to one Redis server, in plain text or over TLS. Uses the protocol of hiredis.
//
//   auto connection = RedisConnection::Connect(endpoint, options, RedisPeer::kRedis);
//   (*connection)->Append(FormatRedisCommand({"RPUSHX", key, value}));
//   auto reply = (*connection)->Read();
//
// Commands are sent together when the first reply is read. Each command has one reply, in order.
// After a reply that did not come in time nobody can tell to which command the next one belongs, so
// a connection that has failed once stays failed. Whatever the server answers, replies are bounded
// in size and in the time that they take.
//
// Not thread-safe. Read() waits at most RedisOptions::timeout for each part of a reply, and at most
// kTimeoutsOfReply times as long for all of it. Connect() waits as long for each of its steps.
#pragma once

#include <hiredis/hiredis.h>

#include <cstddef>
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

// Returns the text of an element of an array. REQUIRES: the array has it.
inline std::string TextAt(const redisReply& reply, size_t i) {
  return std::string(TextOf(*reply.element[i]));
}

// Returns whether a reply is an array of that many elements.
inline bool IsArrayOf(const redisReply& reply, size_t elements) {
  return reply.type == REDIS_REPLY_ARRAY && reply.elements == elements;
}

// Returns UNAVAILABLE, for a reply that is none of those that the command can have.
absl::Status UnexpectedReply(absl::string_view expected);

// Returns OK, or UNAVAILABLE with the text of an error reply.
absl::Status RedisStatus(const redisReply& reply);

enum class RedisPeer { kRedis, kSentinel };

class RedisConnection {
 public:
  static constexpr int kTimeoutsOfReply = 10;
  // Bounds of one reply. Redis itself allows no longer string.
  static constexpr size_t kMostReplyBytes = size_t{512} << 20;
  static constexpr size_t kMostReplyElements = 1 << 20;

  // Connects and authenticates. Returns UNAVAILABLE if it cannot.
  static absl::StatusOr<std::unique_ptr<RedisConnection>> Connect(const RedisEndpoint& endpoint,
                                                                  const RedisOptions& options,
                                                                  RedisPeer peer);

  const RedisEndpoint& endpoint() const { return endpoint_; }

  // Takes a command of FormatRedisCommand().
  void Append(absl::string_view command) { unsent_.append(command.data(), command.size()); }

  // Returns the reply to the oldest command without one, which may be an error. Returns UNAVAILABLE
  // if the server does not answer, and from then on always.
  absl::StatusOr<RedisReply> Read();

  // Returns why the connection has failed, or OK.
  const absl::Status& failure() const { return failure_; }

  // Runs one command. Returns UNAVAILABLE also if the reply is an error.
  absl::StatusOr<RedisReply> Run(absl::Span<const absl::string_view> arguments);

 private:
  struct ContextDeleter {
    void operator()(redisContext* context) const { redisFree(context); }
  };
  RedisConnection(RedisEndpoint endpoint, absl::Duration timeout, redisContext* context)
      : endpoint_(std::move(endpoint)), timeout_(timeout), context_(context) {}

  absl::Status Authenticate(const RedisOptions& options, RedisPeer peer);
  absl::StatusOr<RedisReply> ReadNext();
  // Returns the next reply if all of it has arrived, and otherwise null.
  absl::StatusOr<RedisReply> Parse();
  absl::Status SendAll();
  // Reads what has arrived, and waits if it is nothing.
  absl::Status Receive();
  absl::Status Failed(absl::string_view what) const;
  // Returns why the reader has failed: the server sends something else than replies of Redis.
  absl::Status ReaderFailed() const;

  const RedisEndpoint endpoint_;
  const absl::Duration timeout_;
  const std::unique_ptr<redisContext, ContextDeleter> context_;  // owns the socket and the reader
  SslConnection tls_;                                            // null: plain text
  std::string unsent_;
  absl::Status failure_;      // of the first Read() that failed
  bool has_replied_ = false;  // at least once, in the protocol of Redis
  std::string first_bytes_;   // that the server has sent, until it has replied
  size_t reply_bytes_ = 0;    // received since the last reply
  size_t elements_left_ = 0;  // that the arrays of the next reply may still have
};

}  // namespace spikeserve
