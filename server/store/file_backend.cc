#include "server/store/file_backend.h"

#include <fcntl.h>
#include <sys/file.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstring>
#include <filesystem>
#include <map>
#include <set>
#include <system_error>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/clock.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"
#include "core/journal/session_journal.h"
#include "core/session/session_id.h"
#include "core/store/file_repair.h"
#include "core/store/lmdb.h"
#include "core/store/sealed_record.h"
#include "core/store/stored_session.h"
#include "server/base/file_descriptor.h"
#include "server/base/log.h"

namespace spikeserve {

namespace {

// The time of the last record is kept with this resolution, so that most records write nothing
// else.
constexpr absl::Duration kWrittenStep = absl::Minutes(1);

// A time of day that differs by more than this from what has passed has jumped.
constexpr absl::Duration kJump = absl::Minutes(1);

// Bytes of the disk that are kept for the ends of sessions, and the step in which more are taken.
// One transaction writes the pages that it changes to another place.
constexpr size_t kReserveBytes = 4 << 20;
constexpr size_t kSpaceStep = 4 << 20;

// Sessions whose last records were written in the same minutes often have equal descriptions.
constexpr size_t kMostParsed = 1000;

// No number of decisions reaches this one.
constexpr uint64_t kNoDecisions = ~uint64_t{0};

// The locks of a folder, which end with the process.
struct FolderLocks {
  FileDescriptor folder;
  FileDescriptor file;  // of earlier releases
};

class FileBackend final : public JournalBackend {
 public:
  FileBackend(std::string directory, FolderLocks locks, std::function<absl::Time()> now,
              const Clock* clock)
      : directory_(std::move(directory)),
        locks_(std::move(locks)),
        now_(std::move(now)),
        clock_(*clock),
        opened_(clock->Now()),
        opened_at_(now_()) {}

  // Opens the file, or what is left of it.
  absl::Status Open() {
    absl::MutexLock lock(&opening_);
    environment_ = nullptr;
    space_bytes_ = 0;
    ASSIGN_OR_RETURN(auto repair, RepairFileStore(directory_));
    if (repair.has_value()) {
      const FileRepair& done = *repair;
      LogError("session store was damaged; goes on with what can be read",
               {{"damage", done.damage},
                {"kept_as", done.kept_as},
                {"sessions", absl::StrCat(done.sessions)},
                {"whose_end_may_be_missing", absl::StrCat(done.incomplete)},
                {"without_records", absl::StrCat(done.without)},
                {"left_out", absl::StrCat(done.unnamed)}});
    }
    ASSIGN_OR_RETURN(environment_, OpenLmdb(directory_, kMostStoreBytes));
    ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::Begin(environment_.get()));
    ASSIGN_OR_RETURN(const auto sessions, transaction.OpenTable(kSessionsTable));
    ASSIGN_OR_RETURN(const auto records, transaction.OpenTable(kRecordsTable));
    sessions_ = sessions;
    records_ = records;
    return Commit(transaction);
  }

  absl::Status VisitJournals(const JournalVisitor& visitor) {
    ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::BeginToRead(environment_.get()));
    std::map<std::string, uint64_t> decisions;  // of the last record, by session
    RETURN_IF_ERROR(transaction.Scan(records_, "", [&](absl::string_view key, absl::string_view) {
      decisions[std::string(key.substr(0, kStoredIdBytes))] = StoredDecisions(key);
    }));
    for (const auto& [id, number] : decisions) {
      if (!visitor.wants(id, number)) continue;
      std::vector<std::string> records;
      RETURN_IF_ERROR(
          transaction.Scan(records_, id, [&](absl::string_view, absl::string_view bytes) {
            records.push_back(OpenRecord(bytes));
          }));
      visitor.visit(id, std::move(records));
    }
    return visitor.end();
  }

  // Removes old sessions, and dates the others from now on.
  absl::Status RemoveOld(absl::Duration retention) {
    ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::Begin(environment_.get()));
    std::vector<std::string> ids;
    auto status = transaction.Scan(
        sessions_, "", [&](absl::string_view id, absl::string_view) { ids.emplace_back(id); });
    if (!status.ok()) return status;
    std::map<std::string, StoredSession> sessions;
    int64_t newest = 0;
    for (const std::string& id : ids) {
      const auto session = Read(transaction, id);
      // A session whose description is damaged cannot be claimed. It is left for inspection.
      if (!session.ok() || !session->has_value()) continue;
      sessions[id] = **session;
      newest = std::max(newest, (*session)->written_seconds);
    }
    if (sessions.empty() || newest == 0) return absl::OkStatus();
    const absl::Time last = absl::FromUnixSeconds(newest);
    const absl::Time now = std::exchange(opened_at_, last);  // unless the sessions are dated anew
    const absl::Duration passed = now - last;
    if (passed < -kJump || passed > retention) {
      LogWarning(
          "time of day differs from that of the last record in the session store; sessions "
          "do not get older by it",
          {{"last_record", absl::FormatTime(last)}, {"now", absl::FormatTime(now)}});
    }
    for (auto& [id, session] : sessions) {
      const int64_t written = session.written_seconds == 0 ? newest : session.written_seconds;
      session.written_seconds = written + absl::ToInt64Seconds(passed);
      status.Update(absl::Seconds(newest - written) > retention ? Remove(transaction, id)
                                                                : Put(transaction, id, session));
    }
    if (status.ok()) status = Commit(transaction);
    if (status.ok()) opened_at_ = now;
    // Without room for that, they keep their dates.
    return absl::IsUnavailable(status) ? absl::OkStatus() : status;
  }

  absl::StatusOr<std::vector<absl::Status>> Write(
      absl::Span<const JournalRecord> records) override {
    auto outcomes = WriteAll(records);
    if (outcomes.ok()) return outcomes;
    const auto status = Contain(outcomes.status());
    if (environment_ == nullptr) return status;
    return WriteEnds(records, status);
  }

  std::vector<absl::StatusOr<ClaimedJournal>> Claim(
      absl::Span<const JournalClaim> claims) override {
    auto journals = ClaimAll(claims);
    if (journals.ok()) return *std::move(journals);
    const auto status = Contain(journals.status());
    return std::vector<absl::StatusOr<ClaimedJournal>>(claims.size(), status);
  }

  std::optional<int64_t> StoredSessions() const override { return stored_sessions_.load(); }
  absl::Status VisitUnowned(const Visit& visit) override ABSL_LOCKS_EXCLUDED(opening_) {
    absl::ReaderMutexLock lock(&opening_);
    if (environment_ == nullptr) return absl::UnavailableError("session store: is not open");
    return VisitJournals({.begin = nullptr,
                          .wants = [](const std::string&, uint64_t) { return true; },
                          .visit = visit,
                          .end = [] { return absl::OkStatus(); }});
  }

 private:
  // Commits, and counts the sessions that are stored then.
  absl::Status Commit(LmdbTransaction& transaction) {
    ASSIGN_OR_RETURN(const int64_t sessions, transaction.Count(sessions_));
    RETURN_IF_ERROR(transaction.Commit());
    stored_sessions_.store(sessions);
    return absl::OkStatus();
  }

  // Takes room on the disk for `bytes` more, with the reserve. Returns UNAVAILABLE if there is
  // none.
  absl::Status TakeSpace(size_t bytes) {
    if (environment_ == nullptr) return absl::DataLossError("session store: is not open");
    MDB_envinfo info;
    MDB_stat stat;
    int file = -1;
    for (const int error :
         {mdb_env_info(environment_.get(), &info), mdb_env_stat(environment_.get(), &stat),
          mdb_env_get_fd(environment_.get(), &file)}) {
      RETURN_IF_ERROR(LmdbStatus(error));
    }
    const size_t more = bytes + kReserveBytes;
    const size_t needed = (info.me_last_pgno + 1) * stat.ms_psize + more;
    if (needed <= space_bytes_) return absl::OkStatus();
    for (const size_t taken : {needed + kSpaceStep, needed}) {
      if (taken > info.me_mapsize) continue;
      if (fallocate(file, FALLOC_FL_KEEP_SIZE, 0, static_cast<off_t>(taken)) != 0 &&
          (errno == ENOSPC || errno == EDQUOT)) {
        continue;
      }
      space_bytes_ = taken;  // also where the file system cannot reserve anything
      return absl::OkStatus();
    }
    // The end of the file is where it was when most was stored.
    ASSIGN_OR_RETURN(const size_t free, FreeLmdbBytes(environment_.get()));
    if (free >= more) return absl::OkStatus();
    return absl::UnavailableError(absl::StrCat("session store: ", std::strerror(ENOSPC)));
  }

  absl::StatusOr<std::vector<absl::Status>> WriteAll(absl::Span<const JournalRecord> records) {
    size_t bytes = 0;
    for (const JournalRecord& record : records) bytes += record.bytes.size();
    NoteJump();
    RETURN_IF_ERROR(TakeSpace(bytes));
    ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::Begin(environment_.get()));
    std::vector<absl::Status> outcomes;
    for (const JournalRecord& record : records) {
      outcomes.push_back(WriteRecord(transaction, record));
      const absl::StatusCode code = outcomes.back().code();
      const bool is_outcome = code == absl::StatusCode::kOk || code == absl::StatusCode::kAborted ||
                              code == absl::StatusCode::kAlreadyExists;
      if (!is_outcome) return outcomes.back();
    }
    RETURN_IF_ERROR(Commit(transaction));
    return outcomes;
  }

  // Writes the ends of sessions, although `failure` has prevented the writing of all records, which
  // is the outcome of the others.
  std::vector<absl::Status> WriteEnds(absl::Span<const JournalRecord> records,
                                      const absl::Status& failure) {
    std::set<std::string> ended;
    for (const JournalRecord& record : records) {
      if (record.kind != JournalRecord::Kind::kClose) continue;
      // Each by itself, because that needs the least room.
      auto transaction = LmdbTransaction::Begin(environment_.get());
      if (!transaction.ok()) break;
      auto status = WriteRecord(*transaction, record);
      if (absl::IsAborted(status)) continue;  // there is nothing to end
      if (status.ok()) status = Commit(*transaction);
      if (!status.ok()) break;
      ended.insert(record.journal->stored_as());
    }
    std::vector<absl::Status> outcomes;
    for (const JournalRecord& record : records) {
      // What came before the end of a session has no use any more.
      outcomes.push_back(ended.contains(record.journal->stored_as()) ? absl::OkStatus() : failure);
    }
    return outcomes;
  }

  absl::StatusOr<std::vector<absl::StatusOr<ClaimedJournal>>> ClaimAll(
      absl::Span<const JournalClaim> claims) {
    if (environment_ == nullptr) return absl::DataLossError("session store: is not open");
    ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::Begin(environment_.get()));
    std::vector<absl::StatusOr<ClaimedJournal>> journals;
    for (const JournalClaim& claim : claims) {
      journals.push_back(ClaimOne(transaction, claim));
      absl::StatusOr<ClaimedJournal>& journal = journals.back();
      if (absl::IsDataLoss(journal.status())) return journal.status();
      if (absl::IsFailedPrecondition(journal.status())) {
        journal = absl::DataLossError(journal.status().message());
      }
    }
    RETURN_IF_ERROR(transaction.Commit());
    return journals;
  }

  // Returns `status`, or UNAVAILABLE if it is the damage of a page. The file was opened again then.
  absl::Status Contain(const absl::Status& status) {
    if (!absl::IsDataLoss(status)) return status;
    if (auto opened = Open(); !opened.ok()) return absl::UnavailableError(opened.message());
    return absl::UnavailableError(absl::StrCat(status.message(), "; the file was opened again"));
  }

  absl::StatusOr<ClaimedJournal> ClaimOne(LmdbTransaction& transaction, const JournalClaim& claim) {
    std::string id = claim.id;
    ASSIGN_OR_RETURN(auto session, Read(transaction, id));
    if (!session.has_value() || session->tenant != claim.tenant) {
      id = SecondStoredId(claim.tenant, id);
      ASSIGN_OR_RETURN(session, Read(transaction, id));
    }
    if (!session.has_value() || session->tenant != claim.tenant) return NoSuchSession(claim.id);
    const uint64_t former = session->epoch++;
    ClaimedJournal journal = {
        .epoch = session->epoch, .records = {}, .claimed_from = former, .stored_as = id};
    session->written_seconds = absl::ToUnixSeconds(Now());
    RETURN_IF_ERROR(Put(transaction, id, *session));
    RETURN_IF_ERROR(transaction.Scan(records_, id, [&](absl::string_view, absl::string_view bytes) {
      journal.records.push_back(OpenRecord(bytes));
    }));
    return journal;
  }

  // Returns ABORTED or ALREADY_EXISTS if the record is refused.
  absl::Status WriteRecord(LmdbTransaction& transaction, const JournalRecord& record) {
    const SessionJournal::Key& key = record.journal->key();
    const std::string& id = record.journal->stored_as();
    auto found = Read(transaction, id);
    if (absl::IsFailedPrecondition(found.status())) {
      return absl::AbortedError(found.status().message());
    }
    if (!found.ok()) return found.status();
    const bool writes_again = record.kind == JournalRecord::Kind::kOpen && key.claimed_from != 0;
    if (record.kind == JournalRecord::Kind::kOpen && !writes_again) {
      if (found->has_value() && (*found)->tenant != key.tenant && id == key.id) {
        record.journal->OnStoredAs(SecondStoredId(key.tenant, id));
        return WriteRecord(transaction, record);
      }
      if (found->has_value()) return absl::AlreadyExistsError("session_id: already open");
      *found = StoredSession{.tenant = key.tenant, .epoch = key.epoch, .written_seconds = 0};
    } else if (!found->has_value() || (*found)->epoch != key.epoch) {
      return absl::AbortedError("another owner has claimed the session");
    }
    if (record.kind == JournalRecord::Kind::kClose) return Remove(transaction, id);

    // The journal that was claimed had a gap: what stands behind it is of no use.
    if (writes_again) {
      RETURN_IF_ERROR(RemoveBefore(transaction, id, kNoDecisions));
    }

    StoredSession& session = **found;
    const int64_t now = absl::ToUnixSeconds(Now());
    if (now - session.written_seconds >= absl::ToInt64Seconds(kWrittenStep)) {
      session.written_seconds = now;
      RETURN_IF_ERROR(Put(transaction, id, session));
    }
    const std::string record_key = StoredRecordKey(id, record.decisions);
    const std::string sealed = SealRecord(record.bytes);
    RETURN_IF_ERROR(transaction.Put(records_, record_key, sealed));
    const bool replaces = record.kind == JournalRecord::Kind::kSnapshot ||
                          record.kind == JournalRecord::Kind::kRelease;
    if (!replaces) return absl::OkStatus();
    return RemoveBefore(transaction, id, record.decisions);
  }

  absl::StatusOr<std::optional<StoredSession>> Read(LmdbTransaction& transaction,
                                                    const std::string& id) {
    ASSIGN_OR_RETURN(const auto bytes, transaction.Get(sessions_, id));
    if (!bytes.has_value()) return std::nullopt;
    if (const auto known = parsed_.find(*bytes); known != parsed_.end()) return known->second;
    auto session =
        codec::Parse<StoredSession>(std::string(*bytes), "stored session", kStoredSessionFormat);
    // DATA_LOSS is what LMDB finds; here it is this session alone.
    if (!session.ok()) return absl::FailedPreconditionError(session.status().message());
    if (parsed_.size() >= kMostParsed) parsed_.clear();
    return parsed_.emplace(*bytes, *std::move(session)).first->second;
  }

  absl::Status Put(LmdbTransaction& transaction, const std::string& id,
                   const StoredSession& session) {
    return transaction.Put(sessions_, id, codec::Serialize(kStoredSessionFormat, session));
  }

  // Removes the records of a session before the one with `decisions`.
  absl::Status RemoveBefore(LmdbTransaction& transaction, const std::string& id,
                            uint64_t decisions) {
    const std::string end = StoredRecordKey(id, decisions);
    std::vector<std::string> keys;
    auto status = transaction.Scan(records_, id, [&](absl::string_view key, absl::string_view) {
      if (key < end) keys.emplace_back(key);
    });
    for (const std::string& key : keys) {
      if (!status.ok()) break;
      status = transaction.Delete(records_, key);
    }
    return status;
  }

  absl::Status Remove(LmdbTransaction& transaction, const std::string& id) {
    RETURN_IF_ERROR(RemoveBefore(transaction, id, kNoDecisions));
    return transaction.Delete(sessions_, id);
  }

  // Returns the time of the store's clock.
  absl::Time Now() const { return opened_at_ + (clock_.Now() - opened_); }
  // Says that the time of day has jumped.
  void NoteJump() {
    const absl::Duration jumped = now_() - Now();
    if (absl::AbsDuration(jumped - jumped_) < kJump) return;
    jumped_ = jumped;
    LogWarning("time of day has jumped; sessions in the store do not get older by it",
               {{"from_what_has_passed", absl::FormatDuration(jumped)}});
  }

  const std::string directory_;
  const FolderLocks locks_;  // held so that no other server opens the folder
  const std::function<absl::Time()> now_;
  const Clock& clock_;
  const absl::Duration opened_;  // of `clock_`
  absl::Time opened_at_;         // of the store's clock, at `opened_`
  absl::Duration jumped_;        // time of day minus Now(), as far as it was said
  absl::Mutex opening_;  // Open() has it while it replaces what follows, and other threads to read
  LmdbEnvironment environment_;
  size_t space_bytes_ = 0;  // that the file has on the disk, as far as is known
  MDB_dbi sessions_ = 0;
  MDB_dbi records_ = 0;
  std::atomic<int64_t> stored_sessions_ = 0;
  // What Read() has parsed, by the bytes, which are the same for each record of a session.
  std::map<std::string, StoredSession, std::less<>> parsed_;
};

// Returns INVALID_ARGUMENT if another server holds a lock. The folder itself is locked, because it
// cannot be removed under the store as a file in it can.
absl::StatusOr<FolderLocks> LockFolder(const std::string& directory) {
  const std::string path = absl::StrCat(directory, "/owner.lock");
  FolderLocks locks = {
      .folder = FileDescriptor(open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC)),
      .file = FileDescriptor(open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600))};
  if (!locks.folder.valid() || !locks.file.valid()) {
    return absl::InvalidArgumentError(absl::StrCat("cannot write ", path));
  }
  if (flock(locks.folder.get(), LOCK_EX | LOCK_NB) == 0 &&
      flock(locks.file.get(), LOCK_EX | LOCK_NB) == 0) {
    return locks;
  }
  return absl::InvalidArgumentError(
      absl::StrCat("expected a folder that no other server uses, received ", directory));
}

}  // namespace

absl::StatusOr<std::unique_ptr<JournalBackend>> OpenFileBackend(const std::string& directory,
                                                                absl::Duration retention,
                                                                std::function<absl::Time()> now,
                                                                const Clock* clock,
                                                                const JournalVisitor& visitor) {
  static const SteadyClock steady;
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (error) {
    return absl::InvalidArgumentError(
        absl::StrCat("expected a writable folder, received ", directory, ": ", error.message()));
  }
  ASSIGN_OR_RETURN(auto locks, LockFolder(directory));
  auto backend = std::make_unique<FileBackend>(directory, std::move(locks), std::move(now),
                                               clock == nullptr ? &steady : clock);
  RETURN_IF_ERROR(backend->Open());
  if (visitor.begin != nullptr) {
    RETURN_IF_ERROR(visitor.begin(directory));
    if (auto status = backend->VisitJournals(visitor); !status.ok()) {
      LogError("journals not read for the ledger", {{"error", status.message()}});
    }
  }
  RETURN_IF_ERROR(backend->RemoveOld(retention));
  return backend;
}

}  // namespace spikeserve
