#include "server/store/redis_backend.h"

#include <map>
#include <set>
#include <string>
#include <utility>

#include "absl/random/random.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/session/session_journal.h"
#include "core/session/session_store.h"
#include "core/store/redis_client.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

// Starts a journal, or writes it again for its owner, which also replaces an older epoch: of this
// owner, or of a store that has lost a claim. Returns 0 if another owner has the session.
// KEYS: hash, list. ARGV: epoch, owner, tenant, snapshot, retention in milliseconds, prefix of the
// list's key, policy file, 1 if the owner has claimed the session.
constexpr char kOpen[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'owner', 'state')
if found[1] then
  local mine = found[2] == ARGV[2]
  local older = tonumber(found[1]) < tonumber(ARGV[1]) and found[3] == 'open' and
                (mine or ARGV[8] == '1')
  if not older and not (mine and found[1] == ARGV[1]) then return 0 end
  redis.call('DEL', ARGV[6] .. found[1])
end
redis.call('HSET', KEYS[1], 'epoch', ARGV[1], 'owner', ARGV[2], 'tenant', ARGV[3], 'state', 'open',
           'policy', ARGV[7])
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

// Adds a last snapshot, which replaces everything before it, and leaves the session without an
// owner. Returns 0 if another owner has the session.
// KEYS: hash, list. ARGV: epoch, snapshot, retention in milliseconds.
constexpr char kRelease[] = R"(
if redis.call('HGET', KEYS[1], 'epoch') ~= ARGV[1] then return 0 end
if redis.call('RPUSHX', KEYS[2], ARGV[2]) == 0 then return 0 end
redis.call('LTRIM', KEYS[2], -1, -1)
redis.call('HSET', KEYS[1], 'owner', '')
redis.call('PEXPIRE', KEYS[1], ARGV[3])
redis.call('PEXPIRE', KEYS[2], ARGV[3])
return 1)";

// Makes the caller the owner. Returns the new epoch and the journal, or nothing if there is no open
// session of the tenant. If the caller does not have the policy file of the session, changes
// nothing and returns the epoch 0 and the first record. KEYS: hash. ARGV: prefix of the list's key,
// owner, tenant, retention in milliseconds, what to add to the epoch, policy files of the caller,
// each between two line feeds.
constexpr char kClaim[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'tenant', 'state', 'policy')
if not found[1] or found[2] ~= ARGV[3] or found[3] ~= 'open' then return false end
local epoch = string.format('%d', found[1] + ARGV[5])
local from = ARGV[1] .. found[1]
local to = ARGV[1] .. epoch
if redis.call('EXISTS', from) == 0 then return false end
local policy = found[4] or ''
if policy ~= '' and not string.find(ARGV[6], '\n' .. policy .. '\n', 1, true) then
  return {'0', redis.call('LRANGE', from, 0, 0)}
end
redis.call('RENAME', from, to)
redis.call('HSET', KEYS[1], 'epoch', epoch, 'owner', ARGV[2])
redis.call('PEXPIRE', KEYS[1], ARGV[4])
redis.call('PEXPIRE', to, ARGV[4])
return {epoch, redis.call('LRANGE', to, 0, -1)})";

// Moves the journal of the caller to another epoch, without the records after the first ones, which
// were sent and not acknowledged. Returns 1 if that was done, now or before, or if the store does
// not have the journal, and 0 if another owner has the session.
// KEYS: hash. ARGV: prefix of the list's key, owner, epoch, new epoch, number of records to keep or
// 0 for all.
constexpr char kMove[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'owner', 'state')
if not found[1] or found[1] == ARGV[4] then return 1 end
if tonumber(found[1]) < tonumber(ARGV[3]) then return 1 end
if found[1] ~= ARGV[3] or found[2] ~= ARGV[2] or found[3] ~= 'open' then return 0 end
local from = ARGV[1] .. found[1]
if redis.call('EXISTS', from) == 0 then return 1 end
if ARGV[5] ~= '0' then redis.call('LTRIM', from, 0, ARGV[5] - 1) end
redis.call('RENAME', from, ARGV[1] .. ARGV[4])
redis.call('HSET', KEYS[1], 'epoch', ARGV[4])
return 1)";

// A claim adds a random number up to this to the epoch. If a primary fails and its replica did not
// have the last claim yet, the next claim then gets another epoch, and the two owners do not append
// to one list. A journal that is moved gets its new epoch in the same way.
constexpr uint32_t kMostEpochs = 1 << 20;

std::string ListKey(const SessionJournal& journal) {
  return absl::StrCat(RedisListPrefix(journal.key().id), journal.epoch());
}

// Reads what kClaim returned for session `id`.
absl::StatusOr<ClaimedJournal> ReadJournal(const redisReply& claimed, const std::string& id) {
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

class RedisBackend final : public JournalBackend {
 public:
  RedisBackend(RedisOptions options, absl::Duration retention, std::string owner)
      : options_(std::move(options)),
        retention_(absl::StrCat(absl::ToInt64Milliseconds(retention))),
        owner_(std::move(owner)) {}

  absl::StatusOr<std::vector<absl::Status>> Write(absl::Span<const JournalRecord> records) override;
  std::vector<absl::StatusOr<ClaimedJournal>> Claim(absl::Span<const JournalClaim> claims) override;

 private:
  using Claimed = std::vector<absl::StatusOr<ClaimedJournal>>;  // in the order of the claims
  using Journals = std::set<std::shared_ptr<SessionJournal>>;

  // A journal some of whose records were sent and not acknowledged.
  struct Move {
    uint64_t epoch = 0;  // new
    size_t kept = 0;     // records that were acknowledged; 0: a snapshot follows, keep all
  };

  // Runs `exchange` on a connected client, which is dropped if it fails, and waits for the
  // replicas.
  template <typename Result, typename Exchange>
  absl::StatusOr<Result> OnClient(Exchange exchange);
  absl::StatusOr<std::vector<absl::Status>> WriteAll(absl::Span<const JournalRecord> records);
  // Notes that some of `records` may have been written, or may be written later.
  void OnUncertain(absl::Span<const JournalRecord> records);
  // Moves the journals whose records are uncertain. Returns those of unknown length.
  absl::StatusOr<Journals> MoveUncertain();
  void Append(const JournalRecord& record);
  // Reads the replies to Append(). Returns 0 if the record was refused, and for an entry the
  // length of the journal with it.
  absl::StatusOr<int64_t> ReadReplies(const JournalRecord& record);
  // Returns why Redis refused a record: ABORTED or NOT_FOUND.
  absl::StatusOr<absl::Status> ReasonOf(const JournalRecord& record);
  absl::StatusOr<Claimed> ClaimAll(absl::Span<const JournalClaim> claims);

  const RedisOptions options_;
  const std::string retention_;  // milliseconds
  const std::string owner_;
  std::unique_ptr<RedisClient> client_;
  absl::BitGen random_;
  std::map<std::shared_ptr<SessionJournal>, Move> uncertain_;
};

template <typename Result, typename Exchange>
absl::StatusOr<Result> RedisBackend::OnClient(Exchange exchange) {
  if (client_ == nullptr) {
    auto connected = RedisClient::Connect(options_);
    if (!connected.ok()) return connected.status();
    client_ = *std::move(connected);
  }
  absl::StatusOr<Result> result = exchange();
  if (result.ok() && options_.replicas > 0) {
    if (auto status = client_->WaitForReplicas(); !status.ok()) result = status;
  }
  if (absl::IsUnavailable(result.status())) client_ = nullptr;
  return result;
}

absl::StatusOr<std::vector<absl::Status>> RedisBackend::Write(
    absl::Span<const JournalRecord> records) {
  auto outcomes = OnClient<std::vector<absl::Status>>([&] { return WriteAll(records); });
  if (!outcomes.ok()) OnUncertain(records);
  return outcomes;
}

void RedisBackend::OnUncertain(absl::Span<const JournalRecord> records) {
  for (const JournalRecord& record : records) {
    const auto [found, is_first] = uncertain_.try_emplace(record.journal);
    Move& move = found->second;
    if (is_first) {
      move.epoch = record.journal->epoch() + absl::Uniform(random_, 1U, kMostEpochs);
      move.kept = record.records - 1;
    }
    if (record.kind != JournalRecord::Kind::kEntry) move.kept = 0;
  }
}

// Redis may run what the old connection has sent at any time, also after what is sent now. At the
// new epoch it finds nothing: a late snapshot would discard the records after it.
absl::StatusOr<RedisBackend::Journals> RedisBackend::MoveUncertain() {
  for (const auto& [journal, move] : uncertain_) {
    const std::string& id = journal->key().id;
    client_->Append({"EVAL", kMove, "1", RedisHashKey(id), RedisListPrefix(id), owner_,
                     absl::StrCat(journal->epoch()), absl::StrCat(move.epoch),
                     absl::StrCat(move.kept)});
  }
  Journals moved;
  for (const auto& [journal, move] : uncertain_) {
    const auto reply = client_->Read();
    if (!reply.ok()) return reply.status();
    if ((*reply)->integer == 1) moved.insert(journal);
  }
  // An owner whose move is lost would take its own former epoch for one that the store has lost.
  if (options_.replicas > 0 && !moved.empty()) {
    if (auto status = client_->WaitForReplicas(); !status.ok()) return status;
  }
  Journals of_unknown_length;
  for (const auto& [journal, move] : uncertain_) {
    if (moved.contains(journal)) journal->OnMoved(move.epoch);
    if (move.kept == 0) of_unknown_length.insert(journal);
  }
  uncertain_.clear();
  return of_unknown_length;
}

absl::StatusOr<std::vector<absl::Status>> RedisBackend::WriteAll(
    absl::Span<const JournalRecord> records) {
  auto of_unknown_length = MoveUncertain();
  if (!of_unknown_length.ok()) return of_unknown_length.status();
  for (const JournalRecord& record : records) Append(record);
  std::vector<absl::Status> outcomes(records.size());
  std::vector<size_t> refused;
  for (size_t i = 0; i < records.size(); ++i) {
    const JournalRecord& record = records[i];
    const auto reply = ReadReplies(record);
    if (!reply.ok()) return reply.status();
    if (*reply == 0) {
      refused.push_back(i);
    } else if (record.kind != JournalRecord::Kind::kEntry) {
      of_unknown_length->erase(record.journal);
    } else if (*reply != static_cast<int64_t>(record.records) &&
               !of_unknown_length->contains(record.journal)) {
      outcomes[i] = absl::NotFoundError("the store has lost records of the session");
    }
  }
  for (const size_t i : refused) {
    auto reason = ReasonOf(records[i]);
    if (!reason.ok()) return reason.status();
    outcomes[i] = *std::move(reason);
  }
  return outcomes;
}

void RedisBackend::Append(const JournalRecord& record) {
  const SessionJournal::Key& key = record.journal->key();
  const std::string hash = RedisHashKey(key.id);
  const std::string list = ListKey(*record.journal);
  const std::string epoch = absl::StrCat(record.journal->epoch());
  switch (record.kind) {
    case JournalRecord::Kind::kOpen:
      return client_->Append({"EVAL", kOpen, "2", hash, list, epoch, owner_, key.tenant,
                              record.bytes, retention_, RedisListPrefix(key.id), key.policy_file,
                              record.journal->is_new() ? "0" : "1"});
    case JournalRecord::Kind::kEntry:
      return client_->Append({"RPUSHX", list, record.bytes});
    case JournalRecord::Kind::kSnapshot:
      client_->Append({"RPUSHX", list, record.bytes});
      client_->Append({"LTRIM", list, "-1", "-1"});
      client_->Append({"PEXPIRE", list, retention_});
      return client_->Append({"PEXPIRE", hash, retention_});
    case JournalRecord::Kind::kRelease:
      return client_->Append({"EVAL", kRelease, "2", hash, list, epoch, record.bytes, retention_});
    case JournalRecord::Kind::kClose:
      return client_->Append({"EVAL", kClose, "2", hash, list, epoch, retention_});
  }
}

absl::StatusOr<int64_t> RedisBackend::ReadReplies(const JournalRecord& record) {
  auto first = client_->Read();
  const int others = record.kind == JournalRecord::Kind::kSnapshot ? 3 : 0;
  for (int i = 0; first.ok() && i < others; ++i) {
    if (auto reply = client_->Read(); !reply.ok()) return reply.status();
  }
  if (!first.ok()) return first.status();
  return (*first)->integer;
}

absl::StatusOr<absl::Status> RedisBackend::ReasonOf(const JournalRecord& record) {
  const SessionJournal::Key& key = record.journal->key();
  const auto reply = client_->Run({"HMGET", RedisHashKey(key.id), "epoch", "owner", "state"});
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
  const uint64_t expected = record.journal->epoch();
  if (!absl::SimpleAtoi(text(0), &epoch) || epoch < expected) {
    return absl::NotFoundError("the store does not have the session");
  }
  if (epoch == expected && text(1) == owner_ && text(2) == "open") {
    return absl::NotFoundError("the store does not have the journal of the session");
  }
  return absl::AbortedError("another owner has claimed the session");
}

RedisBackend::Claimed RedisBackend::Claim(absl::Span<const JournalClaim> claims) {
  auto claimed = OnClient<Claimed>([&] { return ClaimAll(claims); });
  return claimed.ok() ? *std::move(claimed) : Claimed(claims.size(), claimed.status());
}

absl::StatusOr<RedisBackend::Claimed> RedisBackend::ClaimAll(
    absl::Span<const JournalClaim> claims) {
  for (const JournalClaim& claim : claims) {
    const std::string step = absl::StrCat(absl::Uniform(random_, 1U, kMostEpochs));
    const std::string files = absl::StrCat("\n", absl::StrJoin(claim.policy_files, "\n"), "\n");
    client_->Append({"EVAL", kClaim, "1", RedisHashKey(claim.id), RedisListPrefix(claim.id), owner_,
                     claim.tenant, retention_, step, files});
  }
  Claimed claimed;
  for (const JournalClaim& claim : claims) {
    const auto reply = client_->Read();
    if (!reply.ok()) return reply.status();
    claimed.push_back(ReadJournal(**reply, claim.id));
  }
  return claimed;
}
}  // namespace

std::unique_ptr<JournalBackend> NewRedisBackend(RedisOptions options, absl::Duration retention,
                                                std::string owner) {
  return std::make_unique<RedisBackend>(std::move(options), retention, std::move(owner));
}

}  // namespace spikeserve
