#include "core/store/shared_redis.h"

#include "core/base/status_macros.h"

namespace spikeserve {

absl::StatusOr<RedisReply> SharedRedis::Run(bool writes,
                                            std::initializer_list<absl::string_view> arguments) {
  absl::MutexLock lock(&mutex_);
  if (client_ == nullptr || !client_->is_usable()) {
    ASSIGN_OR_RETURN(client_, RedisClient::Connect(options_));
  }
  auto reply = client_->Run(arguments);
  if (reply.ok() && writes && options_.replicas > 0) {
    if (auto status = client_->WaitForReplicas(); !status.ok()) reply = status;
  }
  if (!reply.ok()) client_ = nullptr;
  return reply;
}

}  // namespace spikeserve
