// What a Redis server does with writes that it has acknowledged, by its own configuration.
//
//   const RedisDurability redis = ReadRedisDurability(*client);
//   for (const std::string& warning : redis.Warnings(/*replicas=*/0)) ...
//
// Plain data, safe to read from many threads.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/store/redis_client.h"

namespace spikeserve {

// Settings that a server does not tell, such as a managed one, are empty.
struct RedisDurability {
  std::string max_memory;          // bytes; 0: no limit
  std::string eviction;            // maxmemory-policy
  std::string append_only;         // yes or no
  std::string append_fsync;        // always, everysec or no
  std::string min_replicas_write;  // min-replicas-to-write

  // Returns FAILED_PRECONDITION if the server removes keys that have an expiry, as all of a session
  // have, when its memory is full.
  absl::Status CheckKeepsKeys() const;

  // Returns what the server may lose, each with the setting, what was expected and what was
  // received. `replicas` must have a write before it counts (--store_replicas).
  std::vector<std::string> Warnings(int64_t replicas) const;
};

// Asks the server; of a Cluster, one of its nodes. Returns UNAVAILABLE if it does not answer; one
// that refuses to tell a setting has answered.
absl::StatusOr<RedisDurability> ReadRedisDurability(RedisClient& client);

}  // namespace spikeserve
