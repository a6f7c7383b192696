#include "server/store/redis_connection.h"

#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<RedisConnection>> RedisConnection::Connect(
    const RedisAddress& address) {
  const timeval timeout = absl::ToTimeval(kTimeout);
  auto connection = std::unique_ptr<RedisConnection>(
      new RedisConnection(redisConnectWithTimeout(address.host.c_str(), address.port, timeout)));
  redisContext* context = connection->context_.get();
  if (context == nullptr || context->err != 0) {
    return absl::UnavailableError(absl::StrCat("session store: cannot connect to ", address.host,
                                               ":", address.port, ": ",
                                               context == nullptr ? "no memory" : context->errstr));
  }
  redisSetTimeout(context, timeout);
  redisEnableKeepAlive(context);
  if (!address.password.empty()) {
    if (auto status = connection->Run({"AUTH", address.password}); !status.ok()) return status;
  }
  const auto status = connection->Run({"SELECT", absl::StrCat(address.database)});
  if (!status.ok()) return status;
  return connection;
}

absl::Status RedisConnection::Run(std::initializer_list<absl::string_view> arguments) {
  Append(arguments);
  return Read().status();
}

void RedisConnection::Append(std::initializer_list<absl::string_view> arguments) {
  absl::InlinedVector<const char*, 8> values;
  absl::InlinedVector<size_t, 8> sizes;
  for (const absl::string_view argument : arguments) {
    values.push_back(argument.data());
    sizes.push_back(argument.size());
  }
  // An error shows in the replies.
  redisAppendCommandArgv(context_.get(), static_cast<int>(values.size()), values.data(),
                         sizes.data());
}

absl::StatusOr<RedisReply> RedisConnection::Read() {
  void* raw = nullptr;
  if (redisGetReply(context_.get(), &raw) != REDIS_OK) {
    return absl::UnavailableError(absl::StrCat("session store: ", context_->errstr));
  }
  RedisReply reply(static_cast<redisReply*>(raw));
  if (reply->type == REDIS_REPLY_ERROR) {
    return absl::UnavailableError(
        absl::StrCat("session store: ", absl::string_view(reply->str, reply->len)));
  }
  return reply;
}

}  // namespace spikeserve
