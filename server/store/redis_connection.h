// A connection to a Redis server. Uses hiredis.
//
//   auto connection = RedisConnection::Connect(address);
//   (*connection)->Append({"RPUSHX", key, value});
//   auto reply = (*connection)->Read();
//
// Commands are sent together when the first reply is read. Each command has one reply, in order.
// Not thread-safe; Connect() and Read() block for at most kTimeout.
#ifndef SERVER_STORE_REDIS_CONNECTION_H_
#define SERVER_STORE_REDIS_CONNECTION_H_

#include <hiredis/hiredis.h>

#include <initializer_list>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/store/store_options.h"

namespace spikeserve {

struct RedisReplyDeleter {
  void operator()(redisReply* reply) const { freeReplyObject(reply); }
};
using RedisReply = std::unique_ptr<redisReply, RedisReplyDeleter>;

class RedisConnection {
 public:
  static constexpr absl::Duration kTimeout = absl::Seconds(1);

  // Connects, authenticates and selects the database. Returns UNAVAILABLE if it cannot.
  static absl::StatusOr<std::unique_ptr<RedisConnection>> Connect(const RedisAddress& address);

  void Append(std::initializer_list<absl::string_view> arguments);

  // Returns the reply to the oldest command without one. Returns UNAVAILABLE if the server answers
  // with an error or not at all; the connection is of no further use then.
  absl::StatusOr<RedisReply> Read();

 private:
  struct ContextDeleter {
    void operator()(redisContext* context) const { redisFree(context); }
  };
  explicit RedisConnection(redisContext* context) : context_(context) {}

  // Runs a command whose reply is not of interest.
  absl::Status Run(std::initializer_list<absl::string_view> arguments);

  const std::unique_ptr<redisContext, ContextDeleter> context_;
};

}  // namespace spikeserve

#endif  // SERVER_STORE_REDIS_CONNECTION_H_
