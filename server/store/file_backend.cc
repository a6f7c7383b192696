#include "server/store/file_backend.h"

#include <fcntl.h>
#include <sys/file.h>

#include <cerrno>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/session/field_codec.h"
#include "core/session/session_journal.h"
#include "core/session/session_store.h"
#include "core/store/lmdb.h"
#include "core/store/sealed_record.h"
#include "core/store/stored_session.h"
#include "server/base/file_descriptor.h"

namespace spikeserve {

namespace {

// The time of the last record is kept with this resolution, so that most records write nothing
// else.
constexpr absl::Duration kWrittenStep = absl::Minutes(1);

// Returns the key of a record: the session's id, then the number of decisions, which sorts. Records
// of equal numbers replace each other: the end of an episode replaces the entry of its last
// decision.
std::string RecordKey(absl::string_view id, uint64_t decisions) {
  std::string key(id);
  for (int shift = 56; shift >= 0; shift -= 8) key.push_back(static_cast<char>(decisions >> shift));
  return key;
}

class FileBackend final : public JournalBackend {
 public:
  FileBackend(FileDescriptor lock, LmdbEnvironment environment, std::function<absl::Time()> now)
      : lock_(std::move(lock)), environment_(std::move(environment)), now_(std::move(now)) {}

  absl::Status Open(absl::Duration retention);
  absl::StatusOr<std::vector<absl::Status>> Write(absl::Span<const JournalRecord> records) override;
  std::vector<absl::StatusOr<ClaimedJournal>> Claim(absl::Span<const JournalClaim> claims) override;

 private:
  absl::StatusOr<ClaimedJournal> ClaimOne(LmdbTransaction& transaction, const JournalClaim& claim);
  // Returns ABORTED or ALREADY_EXISTS if the record is refused.
  absl::Status WriteRecord(LmdbTransaction& transaction, const JournalRecord& record);
  absl::StatusOr<std::optional<StoredSession>> Read(LmdbTransaction& transaction,
                                                    const std::string& id);
  absl::Status Put(LmdbTransaction& transaction, const std::string& id,
                   const StoredSession& session);
  // Removes the records of a session before the one with `decisions`.
  absl::Status RemoveBefore(LmdbTransaction& transaction, const std::string& id,
                            uint64_t decisions);
  absl::Status Remove(LmdbTransaction& transaction, const std::string& id);
  absl::Status RemoveOld(LmdbTransaction& transaction, absl::Duration retention);
  int64_t NowSeconds() const { return absl::ToUnixSeconds(now_()); }

  const FileDescriptor lock_;  // held so that no other server opens the folder
  const LmdbEnvironment environment_;
  const std::function<absl::Time()> now_;
  MDB_dbi sessions_ = 0;
  MDB_dbi records_ = 0;
};

absl::Status FileBackend::Open(absl::Duration retention) {
  auto transaction = LmdbTransaction::Begin(environment_.get());
  if (!transaction.ok()) return transaction.status();
  const auto sessions = transaction->OpenTable(kSessionsTable);
  if (!sessions.ok()) return sessions.status();
  const auto records = transaction->OpenTable(kRecordsTable);
  if (!records.ok()) return records.status();
  sessions_ = *sessions;
  records_ = *records;
  if (auto status = RemoveOld(*transaction, retention); !status.ok()) return status;
  return transaction->Commit();
}

absl::Status FileBackend::RemoveOld(LmdbTransaction& transaction, absl::Duration retention) {
  std::vector<std::string> ids;
  auto status = transaction.Scan(
      sessions_, "", [&](absl::string_view id, absl::string_view) { ids.emplace_back(id); });
  if (!status.ok()) return status;
  const int64_t oldest = absl::ToUnixSeconds(now_() - retention);
  for (const std::string& id : ids) {
    const auto session = Read(transaction, id);
    // A session whose description is damaged cannot be claimed. It is left for inspection.
    if (!session.ok() || (*session)->written_seconds >= oldest) continue;
    if (status = Remove(transaction, id); !status.ok()) return status;
  }
  return absl::OkStatus();
}

absl::StatusOr<std::vector<absl::Status>> FileBackend::Write(
    absl::Span<const JournalRecord> records) {
  auto transaction = LmdbTransaction::Begin(environment_.get());
  if (!transaction.ok()) return transaction.status();
  std::vector<absl::Status> outcomes;
  for (const JournalRecord& record : records) {
    outcomes.push_back(WriteRecord(*transaction, record));
    const absl::StatusCode code = outcomes.back().code();
    const bool is_outcome = code == absl::StatusCode::kOk || code == absl::StatusCode::kAborted ||
                            code == absl::StatusCode::kAlreadyExists;
    if (!is_outcome) return outcomes.back();
  }
  if (auto status = transaction->Commit(); !status.ok()) return status;
  return outcomes;
}

absl::Status FileBackend::WriteRecord(LmdbTransaction& transaction, const JournalRecord& record) {
  const SessionJournal::Key& key = record.journal->key();
  auto found = Read(transaction, key.id);
  if (absl::IsDataLoss(found.status())) return absl::AbortedError(found.status().message());
  if (!found.ok()) return found.status();
  if (record.kind == JournalRecord::Kind::kOpen) {
    if (found->has_value()) return absl::AlreadyExistsError("session_id: already open");
    *found = StoredSession{.tenant = key.tenant, .epoch = key.epoch, .written_seconds = 0};
  } else if (!found->has_value() || (*found)->epoch != key.epoch) {
    return absl::AbortedError("another owner has claimed the session");
  }
  if (record.kind == JournalRecord::Kind::kClose) return Remove(transaction, key.id);

  StoredSession& session = **found;
  const int64_t now = NowSeconds();
  if (now - session.written_seconds >= absl::ToInt64Seconds(kWrittenStep)) {
    session.written_seconds = now;
    if (auto status = Put(transaction, key.id, session); !status.ok()) return status;
  }
  const std::string record_key = RecordKey(key.id, record.decisions);
  const std::string sealed = SealRecord(record.bytes);
  if (auto status = transaction.Put(records_, record_key, sealed); !status.ok()) return status;
  const bool replaces =
      record.kind == JournalRecord::Kind::kSnapshot || record.kind == JournalRecord::Kind::kRelease;
  if (!replaces) return absl::OkStatus();
  return RemoveBefore(transaction, key.id, record.decisions);
}

std::vector<absl::StatusOr<ClaimedJournal>> FileBackend::Claim(
    absl::Span<const JournalClaim> claims) {
  const auto all_failed = [&](const absl::Status& status) {
    return std::vector<absl::StatusOr<ClaimedJournal>>(claims.size(), status);
  };
  auto transaction = LmdbTransaction::Begin(environment_.get());
  if (!transaction.ok()) return all_failed(transaction.status());
  std::vector<absl::StatusOr<ClaimedJournal>> journals;
  for (const JournalClaim& claim : claims) journals.push_back(ClaimOne(*transaction, claim));
  if (auto status = transaction->Commit(); !status.ok()) return all_failed(status);
  return journals;
}

absl::StatusOr<ClaimedJournal> FileBackend::ClaimOne(LmdbTransaction& transaction,
                                                     const JournalClaim& claim) {
  const std::string& id = claim.id;
  auto session = Read(transaction, id);
  if (!session.ok()) return session.status();
  if (!session->has_value() || (*session)->tenant != claim.tenant) return NoSuchSession(id);
  ClaimedJournal journal = {.epoch = ++(*session)->epoch, .records = {}};
  (*session)->written_seconds = NowSeconds();
  if (auto status = Put(transaction, id, **session); !status.ok()) return status;
  const auto status =
      transaction.Scan(records_, id, [&](absl::string_view, absl::string_view bytes) {
        journal.records.push_back(OpenRecord(bytes));
      });
  if (!status.ok()) return status;
  return journal;
}

absl::StatusOr<std::optional<StoredSession>> FileBackend::Read(LmdbTransaction& transaction,
                                                               const std::string& id) {
  const auto bytes = transaction.Get(sessions_, id);
  if (!bytes.ok()) return bytes.status();
  if (!bytes->has_value()) return std::nullopt;
  const auto json =
      codec::ParseDocument(std::string(**bytes), "stored session", kStoredSessionFormat);
  if (!json.ok()) return absl::DataLossError(json.status().message());
  StoredSession session;
  codec::Reader reader;
  reader.Read(*json, "stored session", session);
  if (!reader.status().ok()) return absl::DataLossError(reader.status().message());
  return session;
}

absl::Status FileBackend::Put(LmdbTransaction& transaction, const std::string& id,
                              const StoredSession& session) {
  std::string bytes;
  codec::Writer writer(&bytes);
  writer.Begin(kStoredSessionFormat);
  writer.Write(session);
  return transaction.Put(sessions_, id, bytes);
}

absl::Status FileBackend::RemoveBefore(LmdbTransaction& transaction, const std::string& id,
                                       uint64_t decisions) {
  const std::string end = RecordKey(id, decisions);
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

absl::Status FileBackend::Remove(LmdbTransaction& transaction, const std::string& id) {
  // No number of decisions reaches the largest one.
  if (auto status = RemoveBefore(transaction, id, ~uint64_t{0}); !status.ok()) return status;
  return transaction.Delete(sessions_, id);
}

// Returns a lock on the folder, which ends with the process. INVALID_ARGUMENT if another holds it.
absl::StatusOr<FileDescriptor> LockFolder(const std::string& directory) {
  const std::string path = absl::StrCat(directory, "/owner.lock");
  FileDescriptor lock(open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600));
  if (!lock.valid()) return absl::InvalidArgumentError(absl::StrCat("cannot write ", path));
  if (flock(lock.get(), LOCK_EX | LOCK_NB) == 0) return lock;
  return absl::InvalidArgumentError(
      absl::StrCat("expected a folder that no other server uses, received ", directory));
}

}  // namespace

absl::StatusOr<std::unique_ptr<JournalBackend>> OpenFileBackend(const std::string& directory,
                                                                absl::Duration retention,
                                                                std::function<absl::Time()> now) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (error) {
    return absl::InvalidArgumentError(
        absl::StrCat("expected a writable folder, received ", directory, ": ", error.message()));
  }
  auto lock = LockFolder(directory);
  if (!lock.ok()) return lock.status();
  auto environment = OpenLmdb(directory, kMostStoreBytes);
  if (!environment.ok()) return environment.status();
  auto backend =
      std::make_unique<FileBackend>(*std::move(lock), *std::move(environment), std::move(now));
  if (auto status = backend->Open(retention); !status.ok()) return status;
  return backend;
}

}  // namespace spikeserve
