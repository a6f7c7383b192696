// A client of Redis that many threads use. Connects at the first command, and again after an error.
//
// Thread-safe. Run() blocks for at most a few RedisOptions::timeout.
#pragma once

#include <initializer_list>
#include <memory>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "core/store/redis_client.h"
#include "core/store/redis_options.h"

namespace spikeserve {

class SharedRedis {
 public:
  explicit SharedRedis(RedisOptions options) : options_(std::move(options)) {}

  // Runs a command, as RedisClient does, and waits for the replicas of Redis if it `writes`. After
  // any error the next command connects anew: a primary that has become a replica answers, too.
  absl::StatusOr<RedisReply> Run(bool writes, std::initializer_list<absl::string_view> arguments)
      ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  const RedisOptions options_;
  absl::Mutex mutex_;
  std::unique_ptr<RedisClient> client_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
