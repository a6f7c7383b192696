// The options of the store that keeps sessions. Plain data, safe to read from many threads.
#pragma once

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/store/redis_options.h"

namespace spikeserve {

// The parts of an address: memory, file:DIR, or one of Redis (redis_options.h).
struct StoreAddress {
  enum class Kind { kMemory, kFile, kRedis };

  Kind kind = Kind::kMemory;
  std::string folder = "";  // kFile only
  RedisAddress redis = {};  // kRedis only
};

// Returns INVALID_ARGUMENT unless `text` is an address.
absl::StatusOr<StoreAddress> ParseStoreAddress(const std::string& text);

struct StoreOptions {
  std::string address = "memory";
  std::string password_file;                      // of Redis; empty: none
  std::string user;                               // of Redis; empty: as the address says
  absl::Duration timeout = kDefaultRedisTimeout;  // of Redis: the longest wait for its answer
  RedisTlsFiles tls_files;                        // of Redis
  int64_t replicas = 0;    // of Redis, that must have a record before it counts
  bool may_evict = false;  // Redis may remove sessions of durability SYNC when its memory is full
  absl::Duration retention = absl::Hours(24);  // time that a session stays after its last use

  // Returns INVALID_ARGUMENT, which names the flag, what was expected and what was received.
  absl::Status Validate() const;
};

}  // namespace spikeserve
