#include "server/store/redis_backend.h"

#include <algorithm>
#include <map>
#include <set>
#include <string>
#include <utility>

#include "absl/random/random.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/strip.h"
#include "core/base/clock.h"
#include "core/base/status_macros.h"
#include "core/journal/session_journal.h"
#include "core/store/redis_client.h"
#include "core/store/redis_durability.h"
#include "core/store/store_reader.h"
#include "core/store/stored_session.h"
#include "server/base/log.h"
#include "server/store/redis_claims.h"
#include "server/store/redis_journal.h"
#include "server/store/redis_scripts.h"

namespace spikeserve {
namespace {

// How long a closed session is remembered, so that neither a late request nor a former owner opens
// it again. Longer than JournalStore::kCheckInterval, within which former owners find out.
constexpr absl::Duration kTombstone = absl::Minutes(10);

// A connection that was used within this time is not tried.
constexpr absl::Duration kFresh = absl::Milliseconds(500);

// How often the settings of Redis are read again, which operators may change while it runs, and how
// often while sessions are refused because of them.
constexpr absl::Duration kLookInterval = absl::Seconds(5);
constexpr absl::Duration kRefusedInterval = absl::Milliseconds(500);

// Returns what names the snapshot with which the journal of an owner begins. With the epoch, it
// also tells the owner whether the hash is still its own.
std::string BaseOf(const SessionJournal& journal, uint64_t base) {
  return absl::StrCat(journal.epoch(), ":", base);
}

// A script that begins with kIsMine.
std::string WithOwner(absl::string_view script) {
  return absl::StrCat(redis_scripts::kIsMine, script);
}

const std::string& PutScript() {
  static const auto* const script = new std::string(WithOwner(redis_scripts::kPut));
  return *script;
}

const std::string& CloseScript() {
  static const auto* const script = new std::string(WithOwner(redis_scripts::kClose));
  return *script;
}

// Returns the most changes of the copy that another owner has stored at `epoch` with which the copy
// of `journal` replaces it. What the store has acknowledged to an owner is in everything that is
// claimed from it afterwards: a store with less than that has lost something. With as much, what is
// stored goes on, unless the owner of `journal` has claimed just this.
int64_t MostReplaced(const SessionJournal& journal, uint64_t epoch) {
  const auto changes = static_cast<int64_t>(journal.durable_changes());
  return epoch == journal.key().claimed_from ? changes : changes - 1;
}

// Returns whether the record is the first one of a new session.
bool Opens(const JournalRecord& record) {
  return record.kind == JournalRecord::Kind::kOpen && record.position == 1 &&
         record.journal->is_new();
}

class RedisBackend final : public JournalBackend {
 public:
  RedisBackend(RedisOptions options, absl::Duration retention, std::string owner, bool may_evict)
      : options_(std::move(options)),
        may_evict_(may_evict),
        retention_(absl::StrCat(absl::ToInt64Milliseconds(retention))),
        tombstone_(absl::StrCat(absl::ToInt64Milliseconds(std::min(retention, kTombstone)))),
        owner_(std::move(owner)) {}

  bool IsShared() const override { return true; }
  absl::Status VisitUnowned(const Visit& visit) override {
    return VisitOwnerless(options_, /*whole=*/false, visit);
  }
  absl::StatusOr<bool> Connect() override {
    if (client_ != nullptr && clock_.Now() - used_ > kFresh) {
      if (!Ping().ok()) client_ = nullptr;
    }
    RETURN_IF_ERROR(EnsureClient());
    const bool refuses = !CheckKeepsRecords().ok();
    if (clock_.Now() - looked_ > (refuses ? kRefusedInterval : kLookInterval)) {
      RETURN_IF_ERROR(LookAtSettings());
    }
    used_ = clock_.Now();
    return std::exchange(is_new_, false);
  }

  absl::Status CheckKeepsRecords() const override {
    return may_evict_ ? absl::OkStatus() : durability_.CheckKeepsKeys();
  }
  absl::StatusOr<std::vector<absl::Status>> Check(absl::Span<const HeldJournal> journals) override {
    return OnClient([&] { return CheckAll(journals); });
  }

  absl::StatusOr<std::vector<absl::Status>> Write(
      absl::Span<const JournalRecord> records) override {
    auto outcomes = OnClient([&] { return WriteAll(records); });
    if (!outcomes.ok()) OnUncertain(records);
    return outcomes;
  }

  std::vector<absl::StatusOr<ClaimedJournal>> Claim(
      absl::Span<const JournalClaim> claims) override {
    std::vector<absl::StatusOr<ClaimedJournal>> results;
    const auto outcome = OnClient([&]() -> absl::StatusOr<Outcomes> {
      results = ClaimRedisJournals(*client_, {owner_, retention_}, claims, random_);
      // A claim may have failed because of its keys alone, or because the connection did.
      RETURN_IF_ERROR(Ping());
      return Outcomes();
    });
    if (outcome.ok()) return results;
    return std::vector<absl::StatusOr<ClaimedJournal>>(claims.size(), outcome.status());
  }

 private:
  using Outcomes = std::vector<absl::Status>;
  using Journals = std::set<std::shared_ptr<SessionJournal>>;

  // A journal some of whose records were sent and not acknowledged.
  struct Move {
    uint64_t epoch = 0;  // new
    size_t kept = 0;     // records that were acknowledged; 0: a snapshot follows, keep all
  };

  // Runs `exchange` on a connected client, which is dropped if it fails, and waits for the
  // replicas.
  template <typename Exchange>
  absl::StatusOr<Outcomes> OnClient(Exchange exchange) {
    RETURN_IF_ERROR(EnsureClient());
    absl::StatusOr<Outcomes> result = exchange();
    if (result.ok() && options_.replicas > 0) {
      if (auto status = client_->WaitForReplicas(); !status.ok()) result = status;
    }
    if (absl::IsUnavailable(result.status())) client_ = nullptr;
    used_ = clock_.Now();
    return result;
  }

  // Returns `error`, which Redis has answered, unless it is one of single keys: a Cluster refuses
  // commands on keys that are under way from one node to another, while all connections work.
  absl::Status FailureOf(const absl::Status& error) const {
    return client_->is_cluster() && client_->is_usable() ? absl::OkStatus() : error;
  }
  absl::Status EnsureClient() {
    if (client_ != nullptr && client_->is_usable()) return absl::OkStatus();
    const absl::Status status = NewClient();
    if (!status.ok()) client_ = nullptr;
    return status;
  }

  // Connects, reads the settings of Redis, and moves the journals whose records are uncertain.
  absl::Status NewClient() {
    ASSIGN_OR_RETURN(client_, RedisClient::Connect(options_));
    is_new_ = true;
    RETURN_IF_ERROR(LookAtSettings());
    return MoveUncertain();
  }

  // Asks the server for an answer that it gives to no other command.
  absl::Status Ping() {
    const std::string expected = absl::StrCat(owner_, "-", ++pings_);
    ASSIGN_OR_RETURN(const auto reply, client_->Run({"PING", expected}));
    return TextOf(*reply) == expected ? absl::OkStatus() : UnexpectedReply("the answer to a PING");
  }

  // Reads the settings of Redis, and logs what they mean if they are others than before.
  absl::Status LookAtSettings() {
    ASSIGN_OR_RETURN(durability_, ReadRedisDurability(*client_));
    looked_ = clock_.Now();
    const std::vector<std::string> warnings = durability_.Warnings(options_.replicas);
    std::string settings = absl::StrJoin(warnings, "; ");
    if (settings != settings_) {
      for (const std::string& warning : warnings) {
        LogWarning("session store may lose records", {{"setting", warning}});
      }
    }
    settings_ = std::move(settings);
    return absl::OkStatus();
  }

  // Notes that some of `records` may have been written, or may be written later.
  void OnUncertain(absl::Span<const JournalRecord> records) {
    for (const JournalRecord& record : records) {
      if (record.kind == JournalRecord::Kind::kConfirm) continue;
      const auto [found, is_first] = uncertain_.try_emplace(record.journal);
      Move& move = found->second;
      if (is_first) {
        move.epoch = NextRedisEpoch(record.journal->epoch(), random_);
        move.kept = record.records - 1;
      }
      if (record.kind != JournalRecord::Kind::kEntry) move.kept = 0;
    }
  }

  // Moves the journals whose records are uncertain. They stay uncertain where Redis refuses that.
  // Redis may run what the old connection has sent at any time, also after what is sent now. At the
  // new epoch it finds nothing: a late snapshot would discard the records after it.
  absl::Status MoveUncertain() {
    for (const auto& [journal, move] : uncertain_) {
      const std::string& id = journal->stored_as();
      const std::string epoch = absl::StrCat(journal->epoch());
      const std::string new_epoch = absl::StrCat(move.epoch);
      client_->Append({"EVAL", redis_scripts::kMove, "3", RedisHashKey(id), RedisListKey(id, epoch),
                       RedisListKey(id, new_epoch), epoch, new_epoch, owner_,
                       absl::StrCat(move.kept)});
    }
    Journals moved;
    Journals refused;
    absl::Status error;
    for (const auto& [journal, move] : uncertain_) {
      const auto reply = client_->Read();
      error.Update(reply.status());
      if (!reply.ok()) {
        refused.insert(journal);
      } else if ((*reply)->integer == 1) {
        moved.insert(journal);
      }
    }
    RETURN_IF_ERROR(FailureOf(error));
    // An owner whose move is lost would take its own former epoch for one that the store has lost.
    if (options_.replicas > 0 && !moved.empty()) {
      RETURN_IF_ERROR(client_->WaitForReplicas());
    }
    for (const auto& [journal, move] : uncertain_) {
      if (moved.contains(journal)) journal->OnMoved(move.epoch);
      if (move.kept == 0 && !refused.contains(journal)) of_unknown_length_.insert(journal);
    }
    std::erase_if(uncertain_, [&](const auto& item) { return !refused.contains(item.first); });
    return absl::OkStatus();
  }

  absl::StatusOr<Outcomes> CheckAll(absl::Span<const HeldJournal> journals) {
    // The others are being written again, or for the first time.
    const auto is_known = [&](const HeldJournal& held, const SessionJournal::Stored& stored) {
      return stored.records > 0 && !held.journal->lost() &&
             !of_unknown_length_.contains(held.journal) && !uncertain_.contains(held.journal);
    };
    std::vector<size_t> asked;
    for (size_t i = 0; i < journals.size(); ++i) {
      const SessionJournal& journal = *journals[i].journal;
      const SessionJournal::Stored stored = journal.stored();
      if (!is_known(journals[i], stored)) continue;
      asked.push_back(i);
      const std::string epoch = absl::StrCat(journal.epoch());
      client_->Append({"EVAL", redis_scripts::kCheck, "2", RedisHashKey(journal.stored_as()),
                       RedisListKey(journal.stored_as(), epoch), epoch, owner_,
                       BaseOf(journal, stored.base), absl::StrCat(stored.records),
                       journals[i].is_used ? retention_ : ""});
    }
    std::vector<size_t> others;
    Outcomes outcomes(journals.size());
    absl::Status error;
    for (const size_t i : asked) {
      const auto reply = client_->Read();
      outcomes[i] = reply.status();
      error.Update(reply.status());
      if (reply.ok() && (*reply)->integer != 1) others.push_back(i);
    }
    for (const size_t i : others) error.Update(FindReason(*journals[i].journal, &outcomes[i]));
    RETURN_IF_ERROR(FailureOf(error));
    return outcomes;
  }

  absl::StatusOr<Outcomes> WriteAll(absl::Span<const JournalRecord> records) {
    RETURN_IF_ERROR(MoveUncertain());
    Outcomes outcomes(records.size());
    std::vector<size_t> sent;
    for (size_t i = 0; i < records.size(); ++i) {
      if (uncertain_.contains(records[i].journal)) {
        outcomes[i] = UnexpectedReply("a journal that Redis moves to another epoch");
        continue;
      }
      Append(records[i]);
      sent.push_back(i);
    }
    foreign_.clear();
    std::map<std::shared_ptr<SessionJournal>, absl::Status> waiting;  // what comes later waits, too
    std::vector<size_t> refused;
    absl::Status error;
    for (const size_t i : sent) {
      const auto is_written = ReadReplies(records[i]);
      error.Update(is_written.status());
      if (!is_written.ok()) waiting.try_emplace(records[i].journal, is_written.status());
      const auto found = waiting.find(records[i].journal);
      if (found != waiting.end()) {
        outcomes[i] = found->second;
      } else if (!*is_written) {
        refused.push_back(i);
      }
    }
    for (const std::string& list : std::exchange(left_over_, {})) {
      error.Update(client_->Run({"DEL", list}).status());
    }
    for (const size_t i : refused) error.Update(FindOutcome(records[i], &outcomes[i]));
    RETURN_IF_ERROR(FailureOf(error));
    return outcomes;
  }

  void Append(const JournalRecord& record) {
    const SessionJournal& journal = *record.journal;
    const std::string hash = RedisHashKey(journal.stored_as());
    const std::string epoch = absl::StrCat(journal.epoch());
    const std::string list = RedisListKey(journal.stored_as(), epoch);
    switch (record.kind) {
      case JournalRecord::Kind::kOpen:
        // Otherwise the next records, which do not wait for the outcome, would come into the list
        // of another session that has this id and is new, too.
        if (Opens(record) && journal.epoch() == 1)
          record.journal->OnMoved(NextRedisEpoch(1, random_));
        return AppendSnapshot(record);
      case JournalRecord::Kind::kSnapshot:
      case JournalRecord::Kind::kRelease:
        return AppendSnapshot(record);
      case JournalRecord::Kind::kEntry:
        client_->Append({"HGET", hash, "base"});
        return client_->Append({"RPUSHX", list, record.bytes});
      case JournalRecord::Kind::kConfirm:
        client_->Append({"HGET", hash, "base"});
        return client_->Append({"LLEN", list});
      case JournalRecord::Kind::kClose:
        return client_->Append({"EVAL", CloseScript(), "2", hash, list, epoch, owner_,
                                absl::StrCat(journal.replaces()), tombstone_});
    }
  }

  void AppendSnapshot(const JournalRecord& record) {
    const SessionJournal& journal = *record.journal;
    const SessionJournal::Key& key = journal.key();
    const std::string& id = journal.stored_as();
    const std::string epoch = absl::StrCat(journal.epoch());
    const bool releases = record.kind == JournalRecord::Kind::kRelease;
    const std::string replaces = absl::StrCat(journal.replaces());
    // While a Cluster moves a slot, a script with a key that it does not have waits until the end.
    const std::string& compared = journal.is_set_back() ? replaces : epoch;
    client_->Append({"EVAL", PutScript(), "3", RedisHashKey(id), RedisListKey(id, epoch),
                     RedisListKey(id, compared), epoch, owner_, replaces, releases ? "" : owner_,
                     key.tenant, record.bytes, retention_, key.policy_file,
                     BaseOf(journal, record.base), absl::StrCat(record.changes),
                     Opens(record) ? "" : absl::StrCat(MostReplaced(journal, journal.replaces()))});
  }

  // Reads the replies to Append(). Returns false if the record was refused, or stands behind a gap.
  // An entry is pushed also if the list is shorter than its owner thinks, because a script that
  // compares first takes Redis more than twice as long. The entry is then not acknowledged, and
  // readers ignore it (ParseJournal).
  absl::StatusOr<bool> ReadReplies(const JournalRecord& record) {
    if (record.kind != JournalRecord::Kind::kEntry &&
        record.kind != JournalRecord::Kind::kConfirm) {
      return ReadPut(record);
    }
    auto base_or = client_->Read();
    auto length_or = client_->Read();
    ASSIGN_OR_RETURN(const auto base, std::move(base_or));
    ASSIGN_OR_RETURN(const auto length, std::move(length_or));
    if (length->integer == 0 || base->type != REDIS_REPLY_STRING) return false;
    if (of_unknown_length_.contains(record.journal)) return true;
    return TextOf(*base) == BaseOf(*record.journal, record.base) &&
           length->integer == static_cast<int64_t>(record.records);
  }

  absl::StatusOr<bool> ReadPut(const JournalRecord& record) {
    ASSIGN_OR_RETURN(const auto reply, client_->Read());
    const bool is_number = reply->type == REDIS_REPLY_INTEGER;
    if (!is_number && reply->type != REDIS_REPLY_STRING) {
      return absl::UnavailableError("session store: expected the outcome of a snapshot");
    }
    if (is_number && reply->integer < 0 && Opens(record)) foreign_.insert(record.journal);
    if (is_number && reply->integer <= 0) return false;
    of_unknown_length_.erase(record.journal);
    if (is_number) return true;
    // What an older epoch has left. If this is not done, it expires.
    left_over_.push_back(RedisListKey(record.journal->stored_as(), TextOf(*reply)));
    return true;
  }

  // Finds the outcome of a record that the store has not taken; see FindReason().
  absl::Status FindOutcome(const JournalRecord& record, absl::Status* outcome) {
    SessionJournal& journal = *record.journal;
    if (!Opens(record)) return FindReason(journal, outcome);
    const SessionJournal::Key& key = journal.key();
    if (foreign_.erase(record.journal) > 0 && journal.stored_as() == key.id) {
      journal.OnStoredAs(SecondStoredId(key.tenant, key.id));
      Append(record);
      ASSIGN_OR_RETURN(const bool is_written, ReadReplies(record));
      if (is_written) return absl::OkStatus();
    }
    *outcome = absl::AlreadyExistsError("session_id: expected one that is not open");
    return absl::OkStatus();
  }

  // Finds why the store does not have what the owner of the journal expects: ABORTED if another
  // owner has it, otherwise NOT_FOUND. Returns UNAVAILABLE, as the reason too, if the store does
  // not answer.
  absl::Status FindReason(SessionJournal& journal, absl::Status* reason) {
    const std::string& id = journal.stored_as();
    *reason = UnexpectedReply("the owner of the session");
    ASSIGN_OR_RETURN(const auto reply, client_->Run({"HMGET", RedisHashKey(id), "epoch", "owner",
                                                     "state", "changes"}));
    if (!IsArrayOf(*reply, 4)) return UnexpectedReply("four fields");
    const std::string epoch = TextAt(*reply, 0);
    if (epoch.empty()) {
      *reason = absl::NotFoundError("the store does not have the session");
      return absl::OkStatus();
    }
    uint64_t number = 0;
    const bool is_mine = TextAt(*reply, 1) == owner_;
    const bool is_known = absl::SimpleAtoi(epoch, &number) && TextAt(*reply, 2) == "open";
    const auto aborted = absl::AbortedError("another owner has claimed the session");
    if (is_known && !is_mine) {
      ASSIGN_OR_RETURN(const auto length, client_->Run({"LLEN", RedisListKey(id, epoch)}));
      *reason = aborted;
      int64_t changes = 0;
      absl::string_view text = TextOf(*reply->element[3]);
      const bool has_changes =
          absl::ConsumePrefix(&text, absl::StrCat(epoch, ":")) && absl::SimpleAtoi(text, &changes);
      changes += std::max(length->integer, 1LL) - 1;
      const bool is_known_owner = number == journal.key().claimed_from && number < journal.epoch();
      if (changes > MostReplaced(journal, number)) return absl::OkStatus();
      if (!has_changes && !is_known_owner) return absl::OkStatus();
      journal.OnSetBack(number);
      if (number >= journal.epoch()) {
        journal.OnMoved(NextRedisEpoch(number, random_));
      }
    } else if (!is_known || number > journal.epoch()) {
      *reason = aborted;
      return absl::OkStatus();
    }
    *reason = absl::NotFoundError("the store has lost records of the session");
    return absl::OkStatus();
  }

  const RedisOptions options_;
  const bool may_evict_;
  const std::string retention_;  // milliseconds
  const std::string tombstone_;  // milliseconds
  const std::string owner_;
  const SteadyClock clock_;
  std::unique_ptr<RedisClient> client_;
  bool is_new_ = false;         // `client_` was made since the last Connect()
  uint64_t pings_ = 0;          // sent
  absl::Duration used_;         // when `client_` answered last
  RedisDurability durability_;  // as of `looked_`
  absl::Duration looked_;       // when the settings were read last
  std::string settings_ = "";   // what was said about them
  absl::BitGen random_;
  std::map<std::shared_ptr<SessionJournal>, Move> uncertain_;
  Journals of_unknown_length_;          // until their next snapshot
  Journals foreign_;                    // refused, because other tenants have their ids
  std::vector<std::string> left_over_;  // lists of older epochs that a snapshot has replaced
};

}  // namespace

std::unique_ptr<JournalBackend> NewRedisBackend(RedisOptions options, absl::Duration retention,
                                                std::string owner, bool may_evict) {
  return std::make_unique<RedisBackend>(std::move(options), retention, std::move(owner), may_evict);
}

}  // namespace spikeserve
