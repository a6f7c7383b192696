#include "server/store/redis_shared.h"

#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

// Returns 0 if the settings have another revision than the one before. KEYS: hash. ARGV: revision,
// settings.
constexpr char kWrite[] = R"(
local found = redis.call('HGET', KEYS[1], 'revision') or '0'
if tonumber(found) + 1 ~= tonumber(ARGV[1]) then return 0 end
redis.call('HSET', KEYS[1], 'revision', ARGV[1], 'settings', ARGV[2])
return 1)";

// Returns the members that were alive lately. KEYS: sorted set. ARGV: member, milliseconds.
constexpr char kBeat[] = R"(
local time = redis.call('TIME')
local now = time[1] * 1000 + math.floor(time[2] / 1000)
redis.call('ZADD', KEYS[1], now, ARGV[1])
redis.call('ZREMRANGEBYSCORE', KEYS[1], '-inf', now - ARGV[2])
return redis.call('ZRANGE', KEYS[1], 0, -1))";

constexpr char kSettings[] = "cfg";

std::string FileKey(const std::string& name) { return absl::StrCat("pf:", name); }

absl::Status Unexpected(absl::string_view expected) {
  return absl::UnavailableError(absl::StrCat("session store: expected ", expected));
}

}  // namespace

absl::StatusOr<RedisReply> RedisShared::Run(bool writes,
                                            std::initializer_list<absl::string_view> arguments) {
  absl::MutexLock lock(&mutex_);
  if (client_ == nullptr) {
    auto connected = RedisClient::Connect(options_);
    if (!connected.ok()) return connected.status();
    client_ = *std::move(connected);
  }
  auto reply = client_->Run(arguments);
  if (reply.ok() && writes && options_.replicas > 0) {
    if (auto status = client_->WaitForReplicas(); !status.ok()) reply = status;
  }
  if (!reply.ok()) client_ = nullptr;
  return reply;
}

absl::StatusOr<SharedSettings::Document> RedisShared::Read() {
  const auto reply = Run(/*writes=*/false, {"HMGET", kSettings, "revision", "settings"});
  if (!reply.ok()) return reply.status();
  Document document;
  if ((*reply)->type != REDIS_REPLY_ARRAY || (*reply)->elements != 2) {
    return Unexpected("a revision and settings");
  }
  const absl::string_view revision = TextOf(*(*reply)->element[0]);
  if (!revision.empty() && !absl::SimpleAtoi(revision, &document.revision)) {
    return Unexpected("a revision");
  }
  document.json = std::string(TextOf(*(*reply)->element[1]));
  return document;
}

absl::Status RedisShared::Write(const Document& document) {
  const auto reply = Run(/*writes=*/true, {"EVAL", kWrite, "1", kSettings,
                                           absl::StrCat(document.revision), document.json});
  if (!reply.ok()) return reply.status();
  if ((*reply)->integer == 1) return absl::OkStatus();
  return absl::AbortedError("settings: another server has changed them");
}

absl::Status RedisShared::PutFile(const std::string& name, const std::string& bytes) {
  return Run(/*writes=*/true, {"SET", FileKey(name), bytes}).status();
}

absl::StatusOr<std::string> RedisShared::GetFile(const std::string& name) {
  const auto reply = Run(/*writes=*/false, {"GET", FileKey(name)});
  if (!reply.ok()) return reply.status();
  if ((*reply)->type == REDIS_REPLY_STRING) return std::string(TextOf(**reply));
  return absl::NotFoundError(absl::StrCat("the store has no file ", name));
}

absl::StatusOr<std::vector<std::string>> RedisShared::Beat() {
  const auto reply = Run(/*writes=*/false, {"EVAL", kBeat, "1", kRedisReplicas, replica_,
                                            absl::StrCat(kAliveMilliseconds)});
  if (!reply.ok()) return reply.status();
  std::vector<std::string> replicas;
  for (size_t i = 0; i < (*reply)->elements; ++i) {
    replicas.emplace_back(TextOf(*(*reply)->element[i]));
  }
  return replicas;
}

absl::Status RedisShared::Leave() {
  return Run(/*writes=*/false, {"ZREM", kRedisReplicas, replica_}).status();
}

}  // namespace spikeserve
