#include "core/store/redis_durability.h"

#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::Status RedisDurability::CheckKeepsKeys() const {
  if (eviction.empty() || eviction == "noeviction" || max_memory == "0") return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("maxmemory-policy of Redis: expected noeviction, received ", eviction,
                   ", which removes sessions when the memory is full"));
}

std::vector<std::string> RedisDurability::Warnings(int64_t replicas) const {
  std::vector<std::string> warnings;
  if (const auto keeps = CheckKeepsKeys(); !keeps.ok()) warnings.emplace_back(keeps.message());
  if (append_only == "no") {
    warnings.emplace_back(
        "appendonly of Redis: expected yes, received no, so that its end loses the sessions that "
        "no server holds");
  } else if (!append_fsync.empty() && append_fsync != "always") {
    warnings.push_back(
        absl::StrCat("appendfsync of Redis: expected always, received ", append_fsync,
                     ", so that its end may lose the last acknowledged decisions of sessions that "
                     "no server holds"));
  }
  int64_t least = 0;
  if (absl::SimpleAtoi(min_replicas_write, &least) && least < replicas) {
    warnings.push_back(
        absl::StrCat("min-replicas-to-write of Redis: expected at least ", replicas,
                     ", the value of --store_replicas, received ", least,
                     ", so that a primary that is cut off takes writes which it loses later"));
  }
  return warnings;
}

absl::StatusOr<RedisDurability> ReadRedisDurability(RedisClient& client) {
  RedisDurability redis;
  const std::pair<const char*, std::string*> settings[] = {
      {"maxmemory", &redis.max_memory},
      {"maxmemory-policy", &redis.eviction},
      {"appendonly", &redis.append_only},
      {"appendfsync", &redis.append_fsync},
      {"min-replicas-to-write", &redis.min_replicas_write}};
  for (const auto& [name, value] : settings) client.Append({"CONFIG", "GET", name});
  absl::Status failure;
  for (const auto& [name, value] : settings) {
    const auto reply = client.Read();
    failure.Update(reply.status());
    if (!reply.ok() || (*reply)->type != REDIS_REPLY_ARRAY || (*reply)->elements != 2) continue;
    *value = std::string(TextOf(*(*reply)->element[1]));
  }
  if (!client.is_usable()) return failure;
  return redis;
}

}  // namespace spikeserve
