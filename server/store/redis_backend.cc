#include "server/store/redis_backend.h"

#include <string>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/session/session_journal.h"
#include "core/session/session_store.h"

namespace spikeserve {
namespace {

// Starts a journal, or writes it again for its owner. Returns 0 if another owner has the session.
// KEYS: hash, list. ARGV: epoch, owner, tenant, snapshot, retention in milliseconds.
constexpr char kOpen[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'owner')
if found[1] and (found[1] ~= ARGV[1] or found[2] ~= ARGV[2]) then return 0 end
redis.call('HSET', KEYS[1], 'epoch', ARGV[1], 'owner', ARGV[2], 'tenant', ARGV[3], 'state', 'open')
redis.call('RPUSH', KEYS[2], ARGV[4])
redis.call('PEXPIRE', KEYS[1], ARGV[5])
redis.call('PEXPIRE', KEYS[2], ARGV[5])
return 1)";

// Ends a journal and leaves a tombstone. Returns 0 if another owner has the session.
// KEYS: hash, list. ARGV: epoch, retention in milliseconds.
constexpr char kClose[] = R"(
if redis.call('HGET', KEYS[1], 'epoch') ~= ARGV[1] then return 0 end
redis.call('HSET', KEYS[1], 'state', 'closed')
redis.call('DEL', KEYS[2])
redis.call('PEXPIRE', KEYS[1], ARGV[2])
return 1)";

// Makes the caller the owner. Returns the new epoch and the journal, or nothing if there is no open
// session of the tenant.
// KEYS: hash. ARGV: prefix of the list's key, owner, tenant, retention in milliseconds.
constexpr char kClaim[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'tenant', 'state')
if not found[1] or found[2] ~= ARGV[3] or found[3] ~= 'open' then return false end
local epoch = string.format('%d', found[1] + 1)
local from = ARGV[1] .. found[1]
local to = ARGV[1] .. epoch
if redis.call('EXISTS', from) == 0 then return false end
redis.call('RENAME', from, to)
redis.call('HSET', KEYS[1], 'epoch', epoch, 'owner', ARGV[2])
redis.call('PEXPIRE', KEYS[1], ARGV[4])
redis.call('PEXPIRE', to, ARGV[4])
return {epoch, redis.call('LRANGE', to, 0, -1)})";

std::string HashKey(const std::string& id) { return absl::StrCat("ss:{", id, "}:o"); }
std::string ListPrefix(const std::string& id) { return absl::StrCat("ss:{", id, "}:"); }
std::string ListKey(const SessionJournal::Key& key) {
  return absl::StrCat(ListPrefix(key.id), key.epoch);
}

class RedisBackend final : public JournalBackend {
 public:
  RedisBackend(RedisAddress address, absl::Duration retention, std::string owner)
      : address_(std::move(address)),
        retention_(absl::StrCat(absl::ToInt64Milliseconds(retention))),
        owner_(std::move(owner)) {}

  absl::StatusOr<std::vector<absl::Status>> Write(absl::Span<const JournalRecord> records) override;
  absl::StatusOr<ClaimedJournal> Claim(const std::string& id, const std::string& tenant) override;

 private:
  // Runs `exchange` on an open connection, which is dropped if it fails.
  template <typename Result, typename Exchange>
  absl::StatusOr<Result> OnConnection(Exchange exchange);
  absl::StatusOr<std::vector<absl::Status>> WriteAll(absl::Span<const JournalRecord> records);
  void Append(const JournalRecord& record);
  // Reads the replies to Append(). Returns 0 if the record was refused.
  absl::StatusOr<int64_t> ReadReplies(const JournalRecord& record);
  // Returns why Redis refused a record: ABORTED or NOT_FOUND.
  absl::StatusOr<absl::Status> ReasonOf(const JournalRecord& record);
  absl::StatusOr<ClaimedJournal> ClaimNow(const std::string& id, const std::string& tenant);

  const RedisAddress address_;
  const std::string retention_;  // milliseconds
  const std::string owner_;
  std::unique_ptr<RedisConnection> connection_;
};

template <typename Result, typename Exchange>
absl::StatusOr<Result> RedisBackend::OnConnection(Exchange exchange) {
  if (connection_ == nullptr) {
    auto connected = RedisConnection::Connect(address_);
    if (!connected.ok()) return connected.status();
    connection_ = *std::move(connected);
  }
  absl::StatusOr<Result> result = exchange();
  if (absl::IsUnavailable(result.status())) connection_ = nullptr;
  return result;
}

absl::StatusOr<std::vector<absl::Status>> RedisBackend::Write(
    absl::Span<const JournalRecord> records) {
  return OnConnection<std::vector<absl::Status>>([&] { return WriteAll(records); });
}

absl::StatusOr<std::vector<absl::Status>> RedisBackend::WriteAll(
    absl::Span<const JournalRecord> records) {
  for (const JournalRecord& record : records) Append(record);
  std::vector<size_t> refused;
  for (size_t i = 0; i < records.size(); ++i) {
    const auto reply = ReadReplies(records[i]);
    if (!reply.ok()) return reply.status();
    if (*reply == 0) refused.push_back(i);
  }
  std::vector<absl::Status> outcomes(records.size());
  for (const size_t i : refused) {
    auto reason = ReasonOf(records[i]);
    if (!reason.ok()) return reason.status();
    outcomes[i] = *std::move(reason);
  }
  return outcomes;
}

void RedisBackend::Append(const JournalRecord& record) {
  const SessionJournal::Key& key = record.journal->key();
  const std::string hash = HashKey(key.id);
  const std::string list = ListKey(key);
  const std::string epoch = absl::StrCat(key.epoch);
  switch (record.kind) {
    case JournalRecord::Kind::kOpen:
      return connection_->Append(
          {"EVAL", kOpen, "2", hash, list, epoch, owner_, key.tenant, record.bytes, retention_});
    case JournalRecord::Kind::kEntry:
      return connection_->Append({"RPUSHX", list, record.bytes});
    case JournalRecord::Kind::kSnapshot:
      connection_->Append({"RPUSHX", list, record.bytes});
      connection_->Append({"LTRIM", list, "-1", "-1"});
      connection_->Append({"PEXPIRE", list, retention_});
      return connection_->Append({"PEXPIRE", hash, retention_});
    case JournalRecord::Kind::kClose:
      return connection_->Append({"EVAL", kClose, "2", hash, list, epoch, retention_});
  }
}

absl::StatusOr<int64_t> RedisBackend::ReadReplies(const JournalRecord& record) {
  auto first = connection_->Read();
  const int others = record.kind == JournalRecord::Kind::kSnapshot ? 3 : 0;
  for (int i = 0; first.ok() && i < others; ++i) {
    if (auto reply = connection_->Read(); !reply.ok()) return reply.status();
  }
  if (!first.ok()) return first.status();
  return (*first)->integer;
}

absl::StatusOr<absl::Status> RedisBackend::ReasonOf(const JournalRecord& record) {
  const SessionJournal::Key& key = record.journal->key();
  connection_->Append({"HMGET", HashKey(key.id), "epoch", "owner", "state"});
  const auto reply = connection_->Read();
  if (!reply.ok()) return reply.status();
  const redisReply& fields = **reply;
  if (fields.type != REDIS_REPLY_ARRAY || fields.elements != 3) {
    return absl::UnavailableError("session store: expected three fields");
  }
  if (record.kind == JournalRecord::Kind::kOpen) {
    return absl::AlreadyExistsError("session_id: expected one that is not open");
  }
  const auto text = [&](size_t i) {
    const redisReply& field = *fields.element[i];
    return field.type == REDIS_REPLY_STRING ? std::string(field.str, field.len) : std::string();
  };
  // Redis has lost the session, or what it has is older than its owner's copy.
  uint64_t epoch = 0;
  if (!absl::SimpleAtoi(text(0), &epoch) || epoch < key.epoch) {
    return absl::NotFoundError("the store does not have the session");
  }
  if (epoch == key.epoch && text(1) == owner_ && text(2) == "open") {
    return absl::NotFoundError("the store does not have the journal of the session");
  }
  return absl::AbortedError("another owner has claimed the session");
}

absl::StatusOr<ClaimedJournal> RedisBackend::Claim(const std::string& id,
                                                   const std::string& tenant) {
  return OnConnection<ClaimedJournal>([&] { return ClaimNow(id, tenant); });
}

absl::StatusOr<ClaimedJournal> RedisBackend::ClaimNow(const std::string& id,
                                                      const std::string& tenant) {
  connection_->Append(
      {"EVAL", kClaim, "1", HashKey(id), ListPrefix(id), owner_, tenant, retention_});
  const auto reply = connection_->Read();
  if (!reply.ok()) return reply.status();
  const redisReply& claimed = **reply;
  if (claimed.type == REDIS_REPLY_NIL) return NoSuchSession(id);
  ClaimedJournal journal;
  const bool is_pair = claimed.type == REDIS_REPLY_ARRAY && claimed.elements == 2 &&
                       claimed.element[0]->type == REDIS_REPLY_STRING &&
                       claimed.element[1]->type == REDIS_REPLY_ARRAY;
  if (!is_pair || !absl::SimpleAtoi(claimed.element[0]->str, &journal.epoch)) {
    return absl::UnavailableError("session store: expected an epoch and a journal");
  }
  const redisReply& records = *claimed.element[1];
  for (size_t i = 0; i < records.elements; ++i) {
    const redisReply& record = *records.element[i];
    if (record.type == REDIS_REPLY_STRING) journal.records.emplace_back(record.str, record.len);
  }
  return journal;
}

}  // namespace

std::unique_ptr<JournalBackend> NewRedisBackend(RedisAddress address, absl::Duration retention,
                                                std::string owner) {
  return std::make_unique<RedisBackend>(std::move(address), retention, std::move(owner));
}

}  // namespace spikeserve
