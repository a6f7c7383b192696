#include "server/heads/redis_head_log.h"

#include <array>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/learning/contribution_budget.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

// Contributors in one command; more make no difference (ContributionBudget::Members()).
constexpr size_t kMostMembers = ContributionBudget::kProtectedMembers;

// How long the marker of an entry stays after the next entry of its session. A session that goes on
// from an older snapshot, because Redis has lost its last one, does not contribute twice within it.
constexpr char kMarkerGrace[] = "600000";  // milliseconds

// A server that has not read this many entries reads before it appends.
constexpr char kMostUnread[] = "64";

// How long a log takes no entries after it was written again, or after Redis has started again or
// another one has taken its place, whose files may be older: in this time every server that is
// alive reads it, and one that has taken more of the entries writes its own copy.
constexpr char kSettling[] = "3000";  // milliseconds

constexpr size_t kDigits = 12;  // of a file's SHA-256 in the name of a key

// What names the run of the Redis server, if it tells, and the milliseconds of its clock.
constexpr char kRunAndTime[] = R"(
local info = redis.pcall('INFO', 'server')
local run = type(info) == 'string' and string.match(info, 'run_id:(%x+)') or ''
local time = redis.call('TIME')
local now = string.format('%d', time[1] * 1000 + math.floor(time[2] / 1000))
)";

// Keeps the contributors ARGV[first] to ARGV[first + kMostMembers - 1] in the sorted set `key`.
constexpr char kKeepMembers[] = R"(
local function keep_members(key, first, alive)
  local time = redis.call('TIME')
  local now = time[1] * 1000 + math.floor(time[2] / 1000)
  for i = first, #ARGV do
    if ARGV[i] ~= '' then redis.call('ZADD', key, now, ARGV[i]) end
  end
  redis.call('ZREMRANGEBYSCORE', key, '-inf', now - alive)
  redis.call('PEXPIRE', key, alive)
end
)";

// Appends an entry. Its fields: n, the number; m, the contributors; c, the digest; e, the entry.
// The marker may be gone, so what the caller has not read yet is searched for the entry, too. KEYS:
// log, snapshot, marker, marker of the episode before, contributors. ARGV: id, number and digest of
// the caller's position, entry, retention, grace, time that a contributor counts (all in
// milliseconds), what all entries of the session and the episode begin with, most entries that are
// searched, time that a log takes no entries, contributors. Returns 1, 0 if the log has the entry,
// -1 if it does not have the caller's position, or -2 if it takes no entries now.
constexpr char kAppend[] = R"(
local unread = '-'
if tonumber(ARGV[2]) > 0 then
  local mine = redis.call('XRANGE', KEYS[1], ARGV[1], ARGV[1])[1]
  if not mine or mine[2][6] ~= ARGV[3] then return -1 end
  unread = '(' .. ARGV[1]
end
local settled = redis.call('HMGET', KEYS[2], 'run', 'since')
if settled[1] ~= run then
  settled[2] = settled[1] and now or 0
  redis.call('HSET', KEYS[2], 'run', run, 'since', settled[2])
end
local age = now - (settled[2] or 0)
if age >= 0 and age < tonumber(ARGV[10]) then return -2 end
if redis.call('EXISTS', KEYS[3]) == 1 then return 0 end
local entries = redis.call('XRANGE', KEYS[1], unread, '+', 'COUNT', ARGV[9])
if #entries == tonumber(ARGV[9]) then return -1 end
for _, entry in ipairs(entries) do
  if string.sub(entry[2][8], 1, #ARGV[8]) == ARGV[8] then return 0 end
end
keep_members(KEYS[5], 11, ARGV[7])
local members = redis.call('ZCARD', KEYS[5])
local number, digest = 0, ''
local last = redis.call('XREVRANGE', KEYS[1], '+', '-', 'COUNT', 1)[1]
if last then
  number, digest = tonumber(last[2][2]), last[2][6]
else
  local snapshot = redis.call('HMGET', KEYS[2], 'n', 'c')
  if snapshot[1] then number, digest = tonumber(snapshot[1]), snapshot[2] end
end
local n = string.format('%d', number + 1)
local m = string.format('%d', members)
digest = redis.sha1hex(digest .. '|' .. n .. '|' .. m .. '|' .. ARGV[4])
local id = redis.call('XADD', KEYS[1], '*', 'n', n, 'm', m, 'c', digest, 'e', ARGV[4])
redis.call('SET', KEYS[3], id, 'PX', ARGV[5])
redis.call('PEXPIRE', KEYS[4], ARGV[6])
return 1)";

// KEYS: log, snapshot. ARGV: id, largest number of entries.
constexpr char kTail[] = R"(
local snapshot = redis.call('HMGET', KEYS[2], 'n', 'wanted')
return {snapshot[1] or '0', snapshot[2] or '',
        redis.call('XRANGE', KEYS[1], ARGV[1], '+', 'COUNT', ARGV[2])})";

// KEYS: log, snapshot.
constexpr char kLoad[] = R"(
local snapshot = redis.call('HMGET', KEYS[2], 'id', 'n', 'c', 's')
return {snapshot[1] or '', snapshot[2] or '0', snapshot[3] or '', snapshot[4] or '',
        redis.call('XRANGE', KEYS[1], snapshot[1] or '-', '+')})";

// KEYS: log, snapshot. ARGV: id, number, digest, snapshot.
constexpr char kSnapshot[] = R"(
local at = redis.call('XRANGE', KEYS[1], ARGV[1], ARGV[1])[1]
if not at or at[2][6] ~= ARGV[3] then return 0 end
local stored = redis.call('HMGET', KEYS[2], 'n', 'wanted')
if not stored[2] and tonumber(stored[1] or 0) >= tonumber(ARGV[2]) then return 0 end
redis.call('HSET', KEYS[2], 'id', ARGV[1], 'n', ARGV[2], 'c', ARGV[3], 's', ARGV[4])
redis.call('HDEL', KEYS[2], 'wanted')
redis.call('XTRIM', KEYS[1], 'MINID', ARGV[1])
return 1)";

// Returns 0 if the log does not end as expected. The empty entry at the position keeps the ids of
// later ones above it, whatever the clock says, and lets servers at this position continue. Until
// the new log takes the place of the old one, the snapshot stands for it: see redis_scripts.h.
// KEYS: log, snapshot, new log. ARGV: expected digest, id, number, digest, snapshot.
constexpr char kReplace[] = R"(
local last = redis.call('XREVRANGE', KEYS[1], '+', '-', 'COUNT', 1)[1]
local digest = last and last[2][6] or redis.call('HGET', KEYS[2], 'c') or ''
if digest ~= ARGV[1] then return 0 end
redis.call('DEL', KEYS[3])
if ARGV[2] ~= '0-0' then
  redis.call('XADD', KEYS[3], ARGV[2], 'n', ARGV[3], 'm', '0', 'c', ARGV[4], 'e', '')
end
redis.call('HSET', KEYS[2], 'id', ARGV[2], 'n', ARGV[3], 'c', ARGV[4], 's', ARGV[5],
           'run', run, 'since', now)
redis.call('HDEL', KEYS[2], 'wanted')
if ARGV[2] ~= '0-0' then
  redis.call('RENAME', KEYS[3], KEYS[1])
else
  redis.call('DEL', KEYS[1])
end
return 1)";

absl::Status Unexpected(absl::string_view expected) {
  return absl::UnavailableError(absl::StrCat("session store: expected ", expected));
}

bool IsArray(const redisReply& reply, size_t elements) {
  return reply.type == REDIS_REPLY_ARRAY && reply.elements == elements;
}

// Parses [id, [n, .., m, .., c, .., e, ..]].
absl::StatusOr<LoggedEntry> ParseEntry(const redisReply& reply) {
  if (!IsArray(reply, 2) || !IsArray(*reply.element[1], 8)) {
    return Unexpected("an entry with four fields");
  }
  const redisReply& fields = *reply.element[1];
  LoggedEntry entry;
  entry.position.id = std::string(TextOf(*reply.element[0]));
  entry.position.digest = std::string(TextOf(*fields.element[5]));
  entry.bytes = std::string(TextOf(*fields.element[7]));
  if (!absl::SimpleAtoi(TextOf(*fields.element[1]), &entry.position.number) ||
      !absl::SimpleAtoi(TextOf(*fields.element[3]), &entry.members)) {
    return Unexpected("an entry with two numbers");
  }
  return entry;
}

absl::StatusOr<std::vector<LoggedEntry>> ParseEntries(const redisReply& reply) {
  if (reply.type != REDIS_REPLY_ARRAY) return Unexpected("entries");
  std::vector<LoggedEntry> entries;
  for (size_t i = 0; i < reply.elements; ++i) {
    ASSIGN_OR_RETURN(auto entry, ParseEntry(*reply.element[i]));
    entries.push_back(std::move(entry));
  }
  return entries;
}

std::array<absl::string_view, kMostMembers> Padded(const std::vector<std::string>& members) {
  std::array<absl::string_view, kMostMembers> padded;
  for (size_t i = 0; i < std::min(members.size(), padded.size()); ++i) padded[i] = members[i];
  return padded;
}

const std::string& AppendScript() {
  static const auto* const script =
      new std::string(absl::StrCat(kRunAndTime, kKeepMembers, kAppend));
  return *script;
}

const std::string& KeepScript() {
  static const auto* const script =
      new std::string(absl::StrCat(kKeepMembers, "keep_members(KEYS[1], 2, ARGV[1])\nreturn 1"));
  return *script;
}

std::string Marker(const HeadLogKeys& keys, absl::string_view session, int64_t episode) {
  return absl::StrCat(keys.marker_prefix, session, ":", episode);
}

}  // namespace

HeadLogKeys::HeadLogKeys(absl::string_view policy, int64_t version, absl::string_view sha256) {
  const std::string name = absl::StrCat("{", policy, "@", version, "}:");
  const std::string file = absl::StrCat(name, sha256.substr(0, kDigits));
  log = absl::StrCat("fl:", file);
  snapshot = absl::StrCat("fs:", file);
  marker_prefix = absl::StrCat("fc:", name);
  members_prefix = absl::StrCat("fm:", file, ":");
}

void SendHeadAppend(RedisClient& client, const HeadLogKeys& keys, const HeadPosition& at,
                    const HeadAppend& append, absl::Duration retention) {
  const auto members = Padded(append.members);
  client.Append({"EVAL",
                 AppendScript(),
                 "5",
                 keys.log,
                 keys.snapshot,
                 Marker(keys, append.session, append.episode),
                 Marker(keys, append.session, append.episode - 1),
                 absl::StrCat(keys.members_prefix, append.head),
                 at.id,
                 absl::StrCat(at.number),
                 at.digest,
                 append.bytes,
                 absl::StrCat(absl::ToInt64Milliseconds(retention)),
                 kMarkerGrace,
                 absl::StrCat(kAliveMilliseconds),
                 append.identity,
                 kMostUnread,
                 kSettling,
                 members[0],
                 members[1],
                 members[2],
                 members[3],
                 members[4]});
}

absl::StatusOr<AppendOutcome> ReadHeadAppend(RedisClient& client) {
  ASSIGN_OR_RETURN(const auto reply, client.Read());
  if (reply->type != REDIS_REPLY_INTEGER) return Unexpected("the outcome of an entry");
  if (reply->integer < -1) return AppendOutcome::kSettling;
  if (reply->integer < 0) return AppendOutcome::kStale;
  return reply->integer == 0 ? AppendOutcome::kKnown : AppendOutcome::kAppended;
}

void SendHeadTail(RedisClient& client, const HeadLogKeys& keys, const HeadPosition& from) {
  client.Append({"EVAL", kTail, "2", keys.log, keys.snapshot, from.number == 0 ? "-" : from.id,
                 absl::StrCat(kMostTailEntries)});
}

absl::StatusOr<LogTail> ReadHeadTail(RedisClient& client) {
  ASSIGN_OR_RETURN(const auto reply, client.Read());
  LogTail tail;
  if (!IsArray(*reply, 3) || !absl::SimpleAtoi(TextOf(*reply->element[0]), &tail.snapshot_number)) {
    return Unexpected("the end of a log");
  }
  tail.wants_snapshot = !TextOf(*reply->element[1]).empty();
  ASSIGN_OR_RETURN(tail.entries, ParseEntries(*reply->element[2]));
  return tail;
}

absl::StatusOr<StoredLog> LoadHeadLog(RedisClient& client, const HeadLogKeys& keys) {
  ASSIGN_OR_RETURN(const auto reply, client.Run({"EVAL", kLoad, "2", keys.log, keys.snapshot}));
  StoredLog stored;
  if (!IsArray(*reply, 5) ||
      !absl::SimpleAtoi(TextOf(*reply->element[1]), &stored.snapshot.number)) {
    return Unexpected("a log with its snapshot");
  }
  const absl::string_view id = TextOf(*reply->element[0]);
  if (!id.empty()) stored.snapshot.id = std::string(id);
  stored.snapshot.digest = std::string(TextOf(*reply->element[2]));
  stored.bytes = std::string(TextOf(*reply->element[3]));
  ASSIGN_OR_RETURN(stored.entries, ParseEntries(*reply->element[4]));
  return stored;
}

absl::Status StoreHeadSnapshot(RedisClient& client, const HeadLogKeys& keys,
                               const HeadPosition& position, absl::string_view bytes) {
  return client
      .Run({"EVAL", kSnapshot, "2", keys.log, keys.snapshot, position.id,
            absl::StrCat(position.number), position.digest, bytes})
      .status();
}

absl::Status ReplaceHeadLog(RedisClient& client, const HeadLogKeys& keys,
                            absl::string_view expected_digest, const HeadPosition& position,
                            absl::string_view bytes) {
  ASSIGN_OR_RETURN(
      const auto reply,
      client.Run({"EVAL", absl::StrCat(kRunAndTime, kReplace), "3", keys.log, keys.snapshot,
                  absl::StrCat(keys.log, ":new"), expected_digest, position.id,
                  absl::StrCat(position.number), position.digest, bytes}));
  if (reply->integer == 1) return absl::OkStatus();
  return absl::AbortedError("another server has changed the log");
}

absl::Status RestoreHeadMarkers(RedisClient& client, const HeadLogKeys& keys,
                                absl::Span<const HeadMarker> markers, absl::Duration retention) {
  const std::string milliseconds = absl::StrCat(absl::ToInt64Milliseconds(retention));
  for (const HeadMarker& marker : markers) {
    client.Append(
        {"SET", Marker(keys, marker.session, marker.episode), marker.id, "PX", milliseconds});
  }
  absl::Status outcome;
  for (size_t i = 0; i < markers.size(); ++i) outcome.Update(client.Read().status());
  return outcome;
}

absl::Status AskForHeadSnapshot(RedisClient& client, const HeadLogKeys& keys) {
  return client.Run({"HSET", keys.snapshot, "wanted", "1"}).status();
}

void SendHeadMembers(RedisClient& client, const HeadLogKeys& keys, absl::string_view head,
                     const std::vector<std::string>& members) {
  const auto padded = Padded(members);
  client.Append({"EVAL", KeepScript(), "1", absl::StrCat(keys.members_prefix, head),
                 absl::StrCat(kAliveMilliseconds), padded[0], padded[1], padded[2], padded[3],
                 padded[4]});
}

}  // namespace spikeserve
