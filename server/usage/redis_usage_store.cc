// Keeps the ledger of all servers that share a Redis, in keys of one slot of a Cluster:
//
// - us:{u}:p, a hash: of each process, the number of its last batch and when that was.
// - us:{u}:s, a hash: of each session, when it was booked last, and the totals that were.
// - us:{u}:o<hour>, a hash: of each series, what it has used in an hour that is open; and under the
//   empty field, the number of batches.
// - us:{u}:t<month>, a hash: of each tenant, what it has used in a month.
// - us:{u}:b, a hash: the other parts, packed; `<part>:r` has the revision of a part.
// - us:{u}:h, a set: the parts that are open.
#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status_macros.h"
#include "core/store/shared_redis.h"
#include "server/usage/usage_store.h"

namespace spikeserve {
namespace {

// Books a batch, unless the process has booked it already. KEYS: processes, sessions, the open
// part, the month, open parts. ARGV: process, number, name of the open part, most series, series,
// sessions. A field of the last two ends with the byte 254: series, other series, tenant and
// counts; and session, series, other series, tenant and totals. Times are those of Redis, by which
// journals expire.
constexpr char kBook[] = R"(
local last = redis.call('HGET', KEYS[1], ARGV[1])
if last and tonumber(string.match(last, '^%d+')) >= tonumber(ARGV[2]) then return 0 end
local function parse(text)
  local list = {}
  for number in string.gmatch(text or '', '%S+') do list[#list + 1] = tonumber(number) end
  return list
end
local function format(list)
  local texts = {}
  for i = 1, #list do texts[i] = string.format('%.17g', list[i]) end
  return table.concat(texts, ' ')
end
local function fields(text)
  local list = {}
  for field in string.gmatch(text, '([^\254]*)\254') do list[#list + 1] = field end
  return list
end
local function add(list, more)
  for i = 1, #more do list[i] = (list[i] or 0) + more[i] end
end
local rows, tenants = {}, {}
local function count(series, other, tenant, counts)
  rows[series] = rows[series] or {other = other}
  tenants[tenant] = tenants[tenant] or {}
  add(rows[series], counts)
  add(tenants[tenant], counts)
end
local seconds = redis.call('TIME')[1]
local added = fields(ARGV[5])
for i = 1, #added, 4 do count(added[i], added[i + 1], added[i + 2], parse(added[i + 3])) end
local sessions = fields(ARGV[6])
for i = 1, #sessions, 5 do
  local booked = parse(redis.call('HGET', KEYS[2], sessions[i]))
  local more = {}
  local totals = parse(sessions[i + 4])
  for j = 1, #totals do
    local before = booked[j + 1] or 0
    more[j] = math.max(0, totals[j] - before)
    totals[j] = math.max(totals[j], before)
  end
  count(sessions[i + 1], sessions[i + 2], sessions[i + 3], more)
  redis.call('HSET', KEYS[2], sessions[i], seconds .. ' ' .. format(totals))
end
local function store(key, field, counts)
  local sums = parse(redis.call('HGET', key, field))
  add(sums, counts)
  redis.call('HSET', key, field, format(sums))
end
redis.call('HINCRBY', KEYS[3], '', 1)
for series, counts in pairs(rows) do
  local fits = redis.call('HLEN', KEYS[3]) <= tonumber(ARGV[4]) or
               redis.call('HEXISTS', KEYS[3], series) == 1
  store(KEYS[3], fits and series or counts.other, counts)
end
for tenant, counts in pairs(tenants) do store(KEYS[4], tenant, counts) end
redis.call('SADD', KEYS[5], ARGV[3])
redis.call('HSET', KEYS[1], ARGV[1], ARGV[2] .. ' ' .. seconds)
return 1)";

// KEYS: packed parts, the source if it is open, open parts. ARGV: source, its revision, target, its
// revision, packed rows.
constexpr char kReplacePacked[] = R"(
local is_open = string.sub(ARGV[1], 1, 1) == 'o'
local source = is_open and redis.call('HGET', KEYS[2], '') or
               not is_open and redis.call('HGET', KEYS[1], ARGV[1] .. ':r')
local target = redis.call('HGET', KEYS[1], ARGV[3] .. ':r')
if (source or '') ~= ARGV[2] or (target or '') ~= ARGV[4] then return 0 end
redis.call('HSET', KEYS[1], ARGV[3], ARGV[5])
redis.call('HINCRBY', KEYS[1], ARGV[3] .. ':r', 1)
if is_open then redis.call('DEL', KEYS[2]) end
redis.call('SREM', KEYS[3], ARGV[1])
redis.call('HDEL', KEYS[1], ARGV[1], ARGV[1] .. ':r')
return 1)";

// Removes the fields of a part of a hash that are older than so many seconds, and returns the
// cursor of the next part. The time is the number at `ARGV[3]` of a field. KEYS: hash. ARGV:
// cursor, seconds, position.
constexpr char kForget[] = R"(
local oldest = redis.call('TIME')[1] - ARGV[2]
local found = redis.call('HSCAN', KEYS[1], ARGV[1], 'COUNT', 500)
for i = 1, #found[2], 2 do
  local numbers = {}
  for number in string.gmatch(found[2][i + 1], '%S+') do numbers[#numbers + 1] = tonumber(number) end
  if (numbers[tonumber(ARGV[3])] or 0) < oldest then
    redis.call('HDEL', KEYS[1], found[2][i])
  end
end
return found[1])";

constexpr char kProcessesKey[] = "us:{u}:p";
constexpr char kSessionsKey[] = "us:{u}:s";
constexpr char kPackedKey[] = "us:{u}:b";
constexpr char kOpenKey[] = "us:{u}:h";

std::string OpenKey(absl::string_view part) { return absl::StrCat("us:{u}:", part); }

std::string RedisMonthKey(absl::Time time) {
  return absl::FormatTime("us:{u}:t%Y%m", time, absl::UTCTimeZone());
}

void AppendField(absl::string_view field, std::string* out) {
  absl::StrAppend(out, field, "\xfe");  // no byte of UTF-8
}

// Appends what tells where counts of a series go.
void AppendSeries(const std::string& series, std::string* out) {
  AppendField(series, out);
  AppendField(OtherSeries(series), out);
  AppendField(UsageSeries::FromKey(series).tenant, out);
}

class RedisUsageStore final : public UsageStore {
 public:
  explicit RedisUsageStore(RedisOptions options) : redis_(std::move(options)) {}

  absl::Status Book(const UsageBatch& batch) override {
    std::string series;
    for (const auto& [key, counts] : batch.added) {
      AppendSeries(key, &series);
      AppendField(FormatCounts(counts), &series);
    }
    std::string sessions;
    for (const SessionTotals& session : batch.totals) {
      AppendField(session.session, &sessions);
      AppendSeries(session.series, &sessions);
      std::string totals;
      for (const double total : session.totals) absl::StrAppendFormat(&totals, "%.17g ", total);
      AppendField(totals, &sessions);
    }
    const std::string part = OpenPart(batch.time);
    return redis_
        .Run(/*writes=*/true,
             {"EVAL", kBook, "5", kProcessesKey, kSessionsKey, OpenKey(part),
              RedisMonthKey(batch.time), kOpenKey, batch.source, absl::StrCat(batch.number), part,
              absl::StrCat(kMostSeries), series, sessions})
        .status();
  }

  absl::StatusOr<std::map<std::string, UsageCounts>> MonthOf(absl::Time time) override {
    ASSIGN_OR_RETURN(const auto fields, ReadHash(RedisMonthKey(time)));
    std::map<std::string, UsageCounts> tenants;
    for (const auto& [tenant, counts] : fields) tenants[tenant] = ParseCounts(counts);
    return tenants;
  }

  absl::StatusOr<std::vector<std::string>> Parts() override {
    std::vector<std::string> names;
    ASSIGN_OR_RETURN(const auto open, redis_.Run(/*writes=*/false, {"SMEMBERS", kOpenKey}));
    ASSIGN_OR_RETURN(const auto packed, redis_.Run(/*writes=*/false, {"HKEYS", kPackedKey}));
    for (const auto* reply : {open.get(), packed.get()}) {
      for (size_t i = 0; i < reply->elements; ++i) {
        std::string name(TextOf(*reply->element[i]));
        if (SpanOf(name).has_value()) names.push_back(std::move(name));
      }
    }
    std::ranges::sort(names);
    return names;
  }

  absl::StatusOr<UsagePart> Read(const std::string& part) override {
    UsagePart read = {.name = part};
    const auto span = SpanOf(part);
    if (!span.has_value()) return UnexpectedReply("the name of a part");
    if (part[0] == 'o') {
      const int64_t hour = absl::ToInt64Hours(span->first - absl::UnixEpoch());
      ASSIGN_OR_RETURN(const auto fields, ReadHash(OpenKey(part)));
      for (const auto& [series, value] : fields) {
        if (series.empty()) {
          read.revision = value;
        } else {
          read.rows.push_back({.series = series, .hour = hour, .counts = ParseCounts(value)});
        }
      }
      return read;
    }
    ASSIGN_OR_RETURN(const auto reply, redis_.Run(/*writes=*/false, {"HMGET", kPackedKey, part,
                                                                     absl::StrCat(part, ":r")}));
    if (!IsArrayOf(*reply, 2)) return UnexpectedReply("two fields");
    read.revision = TextAt(*reply, 1);
    if (reply->element[0]->type == REDIS_REPLY_NIL) return read;
    ASSIGN_OR_RETURN(read.rows, UnpackRows(TextOf(*reply->element[0])));
    return read;
  }

  absl::Status Replace(const UsagePart& source, const UsagePart& target,
                       const std::string& packed) override {
    return redis_
        .Run(/*writes=*/true,
             {"EVAL", kReplacePacked, "3", kPackedKey, OpenKey(source.name), kOpenKey, source.name,
              source.revision, target.name, target.revision, packed})
        .status();
  }

  absl::Status Forget(absl::Duration unused) override {
    const std::string seconds = absl::StrCat(absl::ToInt64Seconds(unused));
    for (const auto& [key, position] :
         {std::pair(kProcessesKey, "2"), std::pair(kSessionsKey, "1")}) {
      std::string cursor = "0";
      do {
        ASSIGN_OR_RETURN(
            const auto reply,
            redis_.Run(/*writes=*/true, {"EVAL", kForget, "1", key, cursor, seconds, position}));
        cursor = std::string(TextOf(*reply));
      } while (cursor != "0" && !cursor.empty());
    }
    return absl::OkStatus();
  }

 private:
  absl::StatusOr<std::vector<std::pair<std::string, std::string>>> ReadHash(
      const std::string& key) {
    ASSIGN_OR_RETURN(const auto reply, redis_.Run(/*writes=*/false, {"HGETALL", key}));
    if (reply->type != REDIS_REPLY_ARRAY || reply->elements % 2 != 0)
      return UnexpectedReply("a hash");
    std::vector<std::pair<std::string, std::string>> fields;
    for (size_t i = 0; i < reply->elements; i += 2) {
      fields.emplace_back(TextOf(*reply->element[i]), TextOf(*reply->element[i + 1]));
    }
    return fields;
  }

  SharedRedis redis_;
};

}  // namespace

std::unique_ptr<UsageStore> NewRedisUsageStore(RedisOptions options) {
  return std::make_unique<RedisUsageStore>(std::move(options));
}

}  // namespace spikeserve
