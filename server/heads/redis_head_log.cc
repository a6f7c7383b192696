#include "server/heads/redis_head_log.h"

#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/status_macros.h"
#include "core/store/kept_members.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

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
keep_members(KEYS[5], ARGV[11], ARGV[7])
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

// KEYS: log, snapshot. ARGV: id of the first entry (empty: that of the snapshot, which is read,
// too), most entries.
constexpr char kRead[] = R"(
local snapshot = redis.call('HMGET', KEYS[2], 'id', 'n', 'c', 'wanted')
local bytes, first = '', ARGV[1]
if first == '' then
  bytes, first = redis.call('HGET', KEYS[2], 's') or '', snapshot[1] or '-'
end
return {snapshot[1] or '0-0', snapshot[2] or '0', snapshot[3] or '', snapshot[4] or '', bytes,
        redis.call('XRANGE', KEYS[1], first, '+', 'COUNT', ARGV[2])}
)";
constexpr char kAllEntries[] = "1000000000";

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

// Parses [id, [n, .., m, .., c, .., e, ..]].
absl::StatusOr<LoggedEntry> ParseEntry(const redisReply& reply) {
  if (!IsArrayOf(reply, 2) || !IsArrayOf(*reply.element[1], 8)) {
    return UnexpectedReply("an entry with four fields");
  }
  const redisReply& fields = *reply.element[1];
  LoggedEntry entry;
  entry.position.id = TextAt(reply, 0);
  entry.position.digest = TextAt(fields, 5);
  entry.bytes = TextAt(fields, 7);
  if (!absl::SimpleAtoi(TextOf(*fields.element[1]), &entry.position.number) ||
      !absl::SimpleAtoi(TextOf(*fields.element[3]), &entry.members)) {
    return UnexpectedReply("an entry with two numbers");
  }
  return entry;
}

absl::StatusOr<std::vector<LoggedEntry>> ParseEntries(const redisReply& reply) {
  if (reply.type != REDIS_REPLY_ARRAY) return UnexpectedReply("entries");
  std::vector<LoggedEntry> entries;
  for (size_t i = 0; i < reply.elements; ++i) {
    ASSIGN_OR_RETURN(auto entry, ParseEntry(*reply.element[i]));
    entries.push_back(std::move(entry));
  }
  return entries;
}

absl::StatusOr<StoredLog> ReadLog(RedisClient& client) {
  ASSIGN_OR_RETURN(const auto reply, client.Read());
  StoredLog stored;
  if (!IsArrayOf(*reply, 6) ||
      !absl::SimpleAtoi(TextOf(*reply->element[1]), &stored.snapshot.number)) {
    return UnexpectedReply("a log with its snapshot");
  }
  stored.snapshot.id = TextAt(*reply, 0);
  stored.snapshot.digest = TextAt(*reply, 2);
  stored.wants_snapshot = !TextOf(*reply->element[3]).empty();
  stored.bytes = TextAt(*reply, 4);
  ASSIGN_OR_RETURN(stored.entries, ParseEntries(*reply->element[5]));
  return stored;
}

const std::string& AppendScript() {
  static const auto* const script =
      new std::string(absl::StrCat(kRunAndTime, kKeepMembers, kAppend));
  return *script;
}

const std::string& KeepScript() {
  static const auto* const script = new std::string(
      absl::StrCat(kKeepMembers, "keep_members(KEYS[1], ARGV[2], ARGV[1])\nreturn 1"));
  return *script;
}

}  // namespace

RedisHeadLog::RedisHeadLog(absl::string_view policy, int64_t version, absl::string_view sha256,
                           absl::Duration retention)
    : retention_(absl::StrCat(absl::ToInt64Milliseconds(retention))) {
  const std::string name = absl::StrCat("{", policy, "@", version, "}:");
  const std::string file = absl::StrCat(name, sha256.substr(0, kDigits));
  log_ = absl::StrCat("fl:", file);
  snapshot_ = absl::StrCat("fs:", file);
  marker_prefix_ = absl::StrCat("fc:", name);
  members_prefix_ = absl::StrCat("fm:", file, ":");
}

std::string RedisHeadLog::MarkerOf(absl::string_view session, int64_t episode) const {
  return absl::StrCat(marker_prefix_, session, ":", episode);
}

void RedisHeadLog::SendAppend(RedisClient& client, const HeadPosition& at, const HeadEntry& entry,
                              absl::string_view bytes,
                              const std::vector<std::string>& members) const {
  const Contribution& contribution = entry.contribution;
  client.Append({"EVAL", AppendScript(), "5", log_, snapshot_,
                 MarkerOf(contribution.session, contribution.episode),
                 MarkerOf(contribution.session, contribution.episode - 1),
                 absl::StrCat(members_prefix_, contribution.head), at.id, absl::StrCat(at.number),
                 at.digest, bytes, retention_, kMarkerGrace, absl::StrCat(kAliveMilliseconds),
                 HeadEntryIdentity(entry), kMostUnread, kSettling, absl::StrJoin(members, "\n")});
}

absl::StatusOr<AppendOutcome> RedisHeadLog::ReadAppend(RedisClient& client) {
  ASSIGN_OR_RETURN(const auto reply, client.Read());
  if (reply->type != REDIS_REPLY_INTEGER) return UnexpectedReply("the outcome of an entry");
  if (reply->integer < -1) return AppendOutcome::kSettling;
  if (reply->integer < 0) return AppendOutcome::kStale;
  return reply->integer == 0 ? AppendOutcome::kKnown : AppendOutcome::kAppended;
}

void RedisHeadLog::SendTail(RedisClient& client, const HeadPosition& from) const {
  client.Append({"EVAL", kRead, "2", log_, snapshot_, from.number == 0 ? "-" : from.id,
                 absl::StrCat(kMostEntries)});
}

absl::StatusOr<StoredLog> RedisHeadLog::ReadTail(RedisClient& client) { return ReadLog(client); }

absl::StatusOr<StoredLog> RedisHeadLog::Load(RedisClient& client) const {
  client.Append({"EVAL", kRead, "2", log_, snapshot_, "", kAllEntries});
  return ReadLog(client);
}

absl::Status RedisHeadLog::StoreSnapshot(RedisClient& client, const HeadFold& heads) const {
  const HeadPosition& position = heads.position();
  return client
      .Run({"EVAL", kSnapshot, "2", log_, snapshot_, position.id, absl::StrCat(position.number),
            position.digest, heads.Serialize()})
      .status();
}

absl::Status RedisHeadLog::AskForSnapshot(RedisClient& client) const {
  return client.Run({"HSET", snapshot_, "wanted", "1"}).status();
}

absl::Status RedisHeadLog::Replace(RedisClient& client, absl::string_view expected_digest,
                                   const HeadFold& heads) const {
  const HeadPosition& position = heads.position();
  ASSIGN_OR_RETURN(const auto reply,
                   client.Run({"EVAL", absl::StrCat(kRunAndTime, kReplace), "3", log_, snapshot_,
                               absl::StrCat(log_, ":new"), expected_digest, position.id,
                               absl::StrCat(position.number), position.digest, heads.Serialize()}));
  if (reply->integer != 1) return absl::UnavailableError("another server has changed the log");
  // The markers of older entries stay, unless Redis has lost them, too.
  for (const HeadFold::Folded& entry : heads.last()) {
    client.Append(
        {"SET", MarkerOf(entry.session, entry.episode), entry.position.id, "PX", retention_});
  }
  absl::Status outcome;
  for (size_t i = 0; i < heads.last().size(); ++i) outcome.Update(client.Read().status());
  return outcome;
}

absl::Status RedisHeadLog::KeepMembers(RedisClient& client, const TenantHeads& heads) const {
  size_t sent = 0;
  for (const std::string& tenant : heads.Tenants()) {
    const auto members = heads.Find(tenant)->Members();
    if (members.empty()) continue;
    client.Append({"EVAL", KeepScript(), "1", absl::StrCat(members_prefix_, tenant),
                   absl::StrCat(kAliveMilliseconds), absl::StrJoin(members, "\n")});
    ++sent;
  }
  absl::Status outcome;
  for (; sent > 0; --sent) outcome.Update(client.Read().status());
  return outcome;
}

}  // namespace spikeserve
