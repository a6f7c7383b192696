#include "core/store/store_reader.h"

#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <system_error>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"
#include "core/journal/journal_entry.h"
#include "core/store/lmdb.h"
#include "core/store/redis_client.h"
#include "core/store/redis_durability.h"
#include "core/store/sealed_record.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

// Sessions that are read in one round trip; their journals have megabytes together.
constexpr size_t kReadTogether = 64;

int64_t SizeOf(absl::Span<const std::string> records) {
  int64_t bytes = 0;
  for (const std::string& record : records) bytes += static_cast<int64_t>(record.size());
  return bytes;
}

// Returns the servers that were alive lately. KEYS: sorted set. ARGV: milliseconds.
constexpr char kLiving[] = R"(
local time = redis.call('TIME')
local now = time[1] * 1000 + math.floor(time[2] / 1000)
return redis.call('ZRANGEBYSCORE', KEYS[1], now - ARGV[1], now + ARGV[1]))";

// A session's hash in Redis.
struct RedisSession {
  std::string epoch;
  std::string owner;
  std::string tenant;
  std::string state;
};

// What SCAN has found: the sessions with a hash, and the epochs of lists by session.
struct RedisKeys {
  std::set<std::string> sessions;
  std::map<std::string, std::set<std::string>> lists;
};

void AddKey(absl::string_view key, RedisKeys* keys) {
  absl::string_view rest = key;
  if (!absl::ConsumePrefix(&rest, "ss:{")) return;
  const size_t end = rest.find("}:");
  if (end == absl::string_view::npos) return;
  const std::string id(rest.substr(0, end));
  const std::string part(rest.substr(end + 2));
  part == "o" ? static_cast<void>(keys->sessions.insert(id))
              : static_cast<void>(keys->lists[id].insert(part));
}

void AppendHash(RedisClient& client, const std::string& id) {
  client.Append({"HMGET", RedisHashKey(id), "epoch", "owner", "tenant", "state"});
}

absl::StatusOr<std::optional<RedisSession>> ReadHash(RedisClient& client) {
  ASSIGN_OR_RETURN(const auto reply, client.Read());
  if (reply->type != REDIS_REPLY_ARRAY || reply->elements != 4 ||
      reply->element[0]->type != REDIS_REPLY_STRING) {
    return std::nullopt;
  }
  const auto text = [&](size_t i) { return std::string(TextOf(*reply->element[i])); };
  return RedisSession{.epoch = text(0), .owner = text(1), .tenant = text(2), .state = text(3)};
}

void AppendList(RedisClient& client, const std::string& id, absl::string_view epoch,
                bool whole = true) {
  client.Append({"LRANGE", absl::StrCat(RedisListPrefix(id), epoch), "0", whole ? "-1" : "0"});
}

absl::StatusOr<std::vector<std::string>> ReadList(RedisClient& client) {
  ASSIGN_OR_RETURN(const auto reply, client.Read());
  std::vector<std::string> items;
  for (size_t i = 0; i < reply->elements; ++i) {
    items.emplace_back(TextOf(*reply->element[i]));
  }
  return items;
}

absl::StatusOr<std::vector<std::string>> ReadLiving(RedisClient& client) {
  ASSIGN_OR_RETURN(const auto reply, client.Run({"EVAL", kLiving, "1", kRedisReplicas,
                                                 absl::StrCat(kAliveMilliseconds)}));
  std::vector<std::string> living;
  for (size_t i = 0; i < reply->elements; ++i) living.emplace_back(TextOf(*reply->element[i]));
  return living;
}

// Checks one session, and adds it to `report`. Leaves in `epoch` that of its journal.
absl::Status CheckRedisSession(RedisClient& client, const std::string& id, StoreReport* report,
                               std::string* epoch) {
  // A server may take the session over between the two commands, which renames the list.
  constexpr int kTries = 3;
  for (int i = 0; i < kTries; ++i) {
    AppendHash(client, id);
    ASSIGN_OR_RETURN(const auto session, ReadHash(client));
    if (!session.has_value()) return absl::OkStatus();  // expired meanwhile
    *epoch = session->epoch;
    if (session->state == "closed") {
      ++report->closed;
      return absl::OkStatus();
    }
    AppendList(client, id, *epoch);
    ASSIGN_OR_RETURN(const auto records, ReadList(client));
    if (records.empty() && i + 1 < kTries) continue;
    ++report->open;
    const bool alive = std::find(report->replicas.begin(), report->replicas.end(),
                                 session->owner) != report->replicas.end();
    ++(alive ? report->owned : report->ownerless);
    report->bytes += SizeOf(records);
    const auto status = CheckJournal(id, session->tenant, records, &report->entries);
    if (!status.ok()) report->damaged.push_back({id, std::string(status.message())});
    return absl::OkStatus();
  }
  return absl::OkStatus();
}

// Adds lists that are no journal of an open session. `epochs` are those of the journals.
absl::Status FindOrphans(RedisClient& client, const RedisKeys& keys,
                         const std::map<std::string, std::string>& epochs, StoreReport* report) {
  for (const auto& [id, lists] : keys.lists) {
    for (const std::string& epoch : lists) {
      const auto known = epochs.find(id);
      if (known != epochs.end() && known->second == epoch) continue;
      const std::string key = RedisListPrefix(id) + epoch;
      const auto exists = client.Run({"EXISTS", key});  // it may have been renamed meanwhile
      if (!exists.ok()) return exists.status();
      if ((*exists)->integer == 0) continue;
      report->orphaned.push_back(
          {key, known == epochs.end()
                    ? "a journal without its session"
                    : absl::StrCat("a journal of another epoch than ", known->second)});
    }
  }
  return absl::OkStatus();
}

// Checks a stored session and its journal, of which it counts the entries.
absl::Status CheckStored(const std::string& id, absl::string_view bytes,
                         std::vector<std::string>* journal, int64_t* entries) {
  ASSIGN_OR_RETURN(
      const auto session,
      codec::Parse<StoredSession>(std::string(bytes), "stored session", kStoredSessionFormat));
  RETURN_IF_ERROR(CutDamagedEnd(journal));
  return CheckJournal(id, session.tenant, *journal, entries);
}

}  // namespace

absl::Status CheckJournal(absl::string_view id, absl::string_view tenant,
                          absl::Span<const std::string> records, int64_t* entries) {
  ASSIGN_OR_RETURN(const auto journal, ParseJournal(records));
  const Session& snapshot = journal.snapshot;
  const bool is_own = snapshot.id == id || SecondStoredId(tenant, snapshot.id) == id;
  if (!is_own || snapshot.options.tenant != tenant) {
    return absl::DataLossError("journal: expected the session's own, received another one");
  }
  uint64_t decisions = snapshot.decisions;
  for (const JournalEntry& entry : journal.entries) {
    if (entry.decision < decisions) continue;  // written again
    ++decisions;
    ++*entries;
  }
  if (journal.after_gap == 0) return absl::OkStatus();
  return absl::DataLossError(absl::StrCat("journal: expected decision ", decisions, ", received ",
                                          journal.after_gap, " records after it"));
}

absl::StatusOr<StoreReport> CheckFileStore(const std::string& directory) {
  std::error_code error;
  if (!std::filesystem::exists(std::filesystem::path(directory) / "data.mdb", error)) {
    return absl::NotFoundError(
        absl::StrCat("expected a folder with a session store, received ", directory));
  }
  ASSIGN_OR_RETURN(auto environment, OpenLmdbToRead(directory));
  ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::BeginToRead(environment.get()));
  ASSIGN_OR_RETURN(const auto sessions, transaction.OpenTable(kSessionsTable));
  ASSIGN_OR_RETURN(const auto records, transaction.OpenTable(kRecordsTable));

  StoreReport report;
  std::map<std::string, std::vector<std::string>> journals;
  std::string last;  // the session whose journal is gathered
  std::vector<std::string> journal;
  absl::Status failure;
  const auto check = [&] {
    if (last.empty()) return;
    report.bytes += SizeOf(journal);
    const auto bytes = transaction.Get(sessions, last);
    if (!bytes.ok()) {
      failure = bytes.status();
    } else if (!bytes->has_value()) {
      report.orphaned.push_back({last, "a journal without its session"});
    } else if (const auto status = CheckStored(last, **bytes, &journal, &report.entries);
               !status.ok()) {
      report.damaged.push_back({last, std::string(status.message())});
    }
    journal.clear();
  };
  std::set<std::string> with_records;
  auto status = transaction.Scan(records, "", [&](absl::string_view key, absl::string_view bytes) {
    const std::string id(key.substr(0, kStoredIdBytes));
    if (id != last) {
      check();
      last = id;
      with_records.insert(id);
    }
    journal.push_back(OpenRecord(bytes));
  });
  check();
  status.Update(failure);
  RETURN_IF_ERROR(status);
  RETURN_IF_ERROR(transaction.Scan(sessions, "", [&](absl::string_view id, absl::string_view) {
    ++report.open;
    ++report.ownerless;
    if (!with_records.contains(std::string(id))) {
      report.damaged.push_back({std::string(id), "a session without its journal"});
    }
  }));
  return report;
}

absl::StatusOr<StoreReport> CheckRedisStore(const RedisOptions& options) {
  ASSIGN_OR_RETURN(auto client, RedisClient::Connect(options));
  StoreReport report;
  ASSIGN_OR_RETURN(const auto durability, ReadRedisDurability(*client));
  report.warnings = durability.Warnings(options.replicas);
  ASSIGN_OR_RETURN(report.replicas, ReadLiving(*client));
  RedisKeys keys;
  RETURN_IF_ERROR(
      client->ScanKeys(kRedisSessionKeys, [&](absl::string_view key) { AddKey(key, &keys); }));
  std::map<std::string, std::string> epochs;
  for (const std::string& id : keys.sessions) {
    std::string epoch;
    RETURN_IF_ERROR(CheckRedisSession(*client, id, &report, &epoch));
    if (!epoch.empty()) epochs[id] = epoch;
  }
  RETURN_IF_ERROR(FindOrphans(*client, keys, epochs, &report));
  return report;
}

absl::Status VisitOwnerless(
    const RedisOptions& options, bool whole,
    absl::FunctionRef<void(const std::string& id, const std::vector<std::string>& records)> visit) {
  ASSIGN_OR_RETURN(auto client, RedisClient::Connect(options));
  ASSIGN_OR_RETURN(const auto living, ReadLiving(*client));
  RedisKeys keys;
  RETURN_IF_ERROR(
      client->ScanKeys(kRedisSessionKeys, [&](absl::string_view key) { AddKey(key, &keys); }));
  const std::vector<std::string> ids(keys.sessions.begin(), keys.sessions.end());
  for (size_t i = 0; i < ids.size(); i += kReadTogether) {
    const auto some = absl::MakeSpan(ids).subspan(i, kReadTogether);
    for (const std::string& id : some) AppendHash(*client, id);
    std::vector<absl::string_view> asked;
    for (const std::string& id : some) {
      ASSIGN_OR_RETURN(const auto session, ReadHash(*client));
      if (!session.has_value() || session->state != "open") continue;
      if (std::find(living.begin(), living.end(), session->owner) != living.end()) continue;
      AppendList(*client, id, session->epoch, whole);
      asked.push_back(id);
    }
    for (const absl::string_view id : asked) {
      ASSIGN_OR_RETURN(const auto records, ReadList(*client));
      visit(std::string(id), records);
    }
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
