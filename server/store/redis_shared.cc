#include "server/store/redis_shared.h"

#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/status_macros.h"
#include "core/store/kept_members.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

// Returns 0 if the settings have another revision than the replaced one. KEYS: hash. ARGV:
// revision, settings, replaced revision.
constexpr char kWrite[] = R"(
local found = redis.call('HGET', KEYS[1], 'revision') or '0'
if tonumber(found) ~= tonumber(ARGV[3]) then return 0 end
redis.call('HSET', KEYS[1], 'revision', ARGV[1], 'settings', ARGV[2])
return 1)";

// Returns the members that were alive lately. KEYS: sorted set. ARGV: member, milliseconds.
constexpr char kBeat[] = R"(
keep_members(KEYS[1], ARGV[1], ARGV[2])
return redis.call('ZRANGE', KEYS[1], 0, -1))";

// Notes the files of a server, and forgets those that it has no more and those of servers that are
// not alive. Which file a
// version is, is what the first server that is alive has noted. Returns the number of changes so
// far, and the versions of which another server has another file. KEYS: hash. ARGV: server, servers
// that are alive, lines of version and SHA-256.
constexpr char kCompare[] = R"(
local alive = {}
for server in string.gmatch(ARGV[2], '%S+') do alive[server] = true end
local different = {}
local changed = false
local mine = {}
for version, file in string.gmatch(ARGV[3], '(%S+) (%S+)\n') do
  mine[version] = true
  local found = redis.call('HGET', KEYS[1], version) or ''
  local server, other = string.match(found, '(%S+) (%S+)')
  if server and server ~= ARGV[1] and alive[server] then
    if other ~= file then different[#different + 1] = version end
  elseif found ~= ARGV[1] .. ' ' .. file then
    redis.call('HSET', KEYS[1], version, ARGV[1] .. ' ' .. file)
    changed = changed or other ~= file
  end
end
redis.call('HSET', KEYS[1], 'server:' .. ARGV[1], ARGV[3])
local fields = redis.call('HGETALL', KEYS[1])
for i = 1, #fields, 2 do
  local server = string.match(fields[i], '^server:(.*)$')
  local dead = server and server ~= ARGV[1] and not alive[server]
  local owner = not server and not mine[fields[i]] and string.match(fields[i + 1], '^(%S+) ')
  local dropped = owner and (owner == ARGV[1] or not alive[owner])
  if dead or dropped then
    redis.call('HDEL', KEYS[1], fields[i])
    changed = true  -- one that was taken for dead notes its files again
  end
end
if changed then redis.call('HINCRBY', KEYS[1], 'changes', 1) end
return {redis.call('HGET', KEYS[1], 'changes') or '0', different})";

// Returns the servers that have not noted the file. KEYS: hash. ARGV: servers, line of version and
// SHA-256.
constexpr char kWithout[] = R"(
local without = {}
for server in string.gmatch(ARGV[1], '%S+') do
  local files = redis.call('HGET', KEYS[1], 'server:' .. server) or ''
  if not string.find('\n' .. files, '\n' .. ARGV[2] .. '\n', 1, true) then
    without[#without + 1] = server
  end
end
return without)";

// Writes the report of a server. Returns the server, the age in milliseconds and the report of each
// that is not too old. KEYS: hash. ARGV: server, report, milliseconds.
constexpr char kReport[] = R"(
local time = redis.call('TIME')
local now = time[1] * 1000 + math.floor(time[2] / 1000)
redis.call('HSET', KEYS[1], ARGV[1], string.format('%d ', now) .. ARGV[2])
local found = redis.call('HGETALL', KEYS[1])
local reports = {}
for i = 1, #found, 2 do
  local written, report = string.match(found[i + 1], '^(%d+) (.*)$')
  if written and math.abs(now - written) <= tonumber(ARGV[3]) then
    reports[#reports + 1] = found[i]
    reports[#reports + 1] = string.format('%d', math.max(0, now - written))
    reports[#reports + 1] = report
  else
    redis.call('HDEL', KEYS[1], found[i])
  end
end
return reports)";

// How long a server that is lost stays on the status pages of the others.
constexpr absl::Duration kReportLife = absl::Minutes(10);

constexpr char kSettings[] = "cfg";
constexpr char kServers[] = "pf:servers";
constexpr char kVersions[] = "pf:versions";

std::string FileKey(const std::string& name) { return absl::StrCat("pf:", name); }

}  // namespace

absl::StatusOr<SharedSettings::Document> RedisShared::Read() {
  ASSIGN_OR_RETURN(const auto reply,
                   redis_.Run(/*writes=*/false, {"HMGET", kSettings, "revision", "settings"}));
  Document document;
  if (!IsArrayOf(*reply, 2)) {
    return UnexpectedReply("a revision and settings");
  }
  const absl::string_view revision = TextOf(*reply->element[0]);
  if (!revision.empty() && !absl::SimpleAtoi(revision, &document.revision)) {
    return UnexpectedReply("a revision");
  }
  document.json = TextAt(*reply, 1);
  return document;
}

absl::Status RedisShared::Write(const Document& document, int64_t replaced) {
  ASSIGN_OR_RETURN(
      const auto reply,
      redis_.Run(/*writes=*/true, {"EVAL", kWrite, "1", kSettings, absl::StrCat(document.revision),
                                   document.json, absl::StrCat(replaced)}));
  if (reply->integer == 1) return absl::OkStatus();
  return absl::AbortedError("settings: another server has changed them");
}

absl::Status RedisShared::PutFile(const std::string& name, const std::string& bytes) {
  return redis_.Run(/*writes=*/true, {"SET", FileKey(name), bytes}).status();
}

absl::Status RedisShared::RemoveFile(const std::string& name) {
  return redis_.Run(/*writes=*/true, {"DEL", FileKey(name)}).status();
}

absl::StatusOr<std::string> RedisShared::GetFile(const std::string& name) {
  ASSIGN_OR_RETURN(const auto reply, redis_.Run(/*writes=*/false, {"GET", FileKey(name)}));
  if (reply->type == REDIS_REPLY_STRING) return std::string(TextOf(*reply));
  return absl::NotFoundError(absl::StrCat("the store has no file ", name));
}

absl::StatusOr<SharedSettings::ComparedFiles> RedisShared::CompareFiles(
    const std::vector<VersionFile>& files, const std::vector<std::string>& alive) {
  std::string lines;
  for (const VersionFile& file : files)
    absl::StrAppend(&lines, file.version, " ", file.sha256, "\n");
  ASSIGN_OR_RETURN(const auto reply,
                   redis_.Run(/*writes=*/true, {"EVAL", kCompare, "1", kVersions, replica_,
                                                absl::StrJoin(alive, " "), lines}));
  ComparedFiles compared;
  if (!IsArrayOf(*reply, 2) || !absl::SimpleAtoi(TextOf(*reply->element[0]), &compared.revision)) {
    return UnexpectedReply("the outcome of a comparison");
  }
  const redisReply& different = *reply->element[1];
  for (size_t i = 0; i < different.elements; ++i) {
    compared.different.emplace_back(TextOf(*different.element[i]));
  }
  return compared;
}

absl::StatusOr<std::vector<std::string>> RedisShared::ServersWithout(
    const VersionFile& file, const std::vector<std::string>& servers) {
  ASSIGN_OR_RETURN(
      const auto reply,
      redis_.Run(/*writes=*/false, {"EVAL", kWithout, "1", kVersions, absl::StrJoin(servers, " "),
                                    absl::StrCat(file.version, " ", file.sha256)}));
  if (reply->type != REDIS_REPLY_ARRAY) return UnexpectedReply("names of servers");
  std::vector<std::string> without;
  for (size_t i = 0; i < reply->elements; ++i) without.emplace_back(TextOf(*reply->element[i]));
  return without;
}

absl::StatusOr<int64_t> RedisShared::FilesRevision() {
  ASSIGN_OR_RETURN(const auto reply, redis_.Run(/*writes=*/false, {"HGET", kVersions, "changes"}));
  int64_t revision = 0;
  const absl::string_view text = TextOf(*reply);
  if (!text.empty() && !absl::SimpleAtoi(text, &revision))
    return UnexpectedReply("a number of changes");
  return revision;
}

absl::StatusOr<std::vector<std::string>> RedisShared::Heartbeat() {
  ASSIGN_OR_RETURN(
      const auto reply,
      redis_.Run(/*writes=*/false, {"EVAL", absl::StrCat(kKeepMembers, kBeat), "1", kRedisReplicas,
                                    replica_, absl::StrCat(kAliveMilliseconds)}));
  std::vector<std::string> replicas;
  for (size_t i = 0; i < reply->elements; ++i) {
    replicas.emplace_back(TextOf(*reply->element[i]));
  }
  return replicas;
}

absl::StatusOr<std::vector<ReplicaReport>> RedisShared::Report(const std::string& json,
                                                               absl::Duration now) {
  ASSIGN_OR_RETURN(
      const auto reply,
      redis_.Run(/*writes=*/false, {"EVAL", kReport, "1", kServers, replica_, json,
                                    absl::StrCat(absl::ToInt64Milliseconds(kReportLife))}));
  if (reply->type != REDIS_REPLY_ARRAY || reply->elements % 3 != 0) {
    return UnexpectedReply("the reports of servers");
  }
  std::vector<ReplicaReport> reports;
  for (size_t i = 0; i < reply->elements; i += 3) {
    int64_t age = 0;
    if (!absl::SimpleAtoi(TextOf(*reply->element[i + 1]), &age)) return UnexpectedReply("an age");
    reports.push_back({.replica = TextAt(*reply, i),
                       .written = now - absl::Milliseconds(age),
                       .json = TextAt(*reply, i + 2)});
  }
  return reports;
}

absl::Status RedisShared::Leave() {
  if (auto status = redis_.Run(/*writes=*/false, {"HDEL", kServers, replica_}).status();
      !status.ok()) {
    return status;
  }
  return redis_.Run(/*writes=*/false, {"ZREM", kRedisReplicas, replica_}).status();
}

}  // namespace spikeserve
