#include "core/store/file_repair.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <map>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"
#include "core/journal/journal_entry.h"
#include "core/store/lmdb.h"
#include "core/store/lmdb_file.h"
#include "core/store/sealed_record.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

constexpr size_t kNumberBytes = 8;  // of the decisions in a record's key

absl::Status FileError(const std::string& path) {
  return absl::UnavailableError(absl::StrCat(path, ": ", std::strerror(errno)));
}

// Copies what can be read of a damaged file to a new store.
class Salvage {
 public:
  Salvage(const std::string& damaged, MDB_env* target, FileRepair* repair)
      : damaged_(damaged), target_(target), repair_(*repair) {}

  absl::Status Run() {
    RETURN_IF_ERROR(Open());
    ASSIGN_OR_RETURN(const auto damage,
                     ScanLmdbFile(
                         damaged_,
                         [this](absl::string_view table, absl::string_view key,
                                absl::string_view value) { CopyKey(table, key, value); },
                         [this](absl::string_view table) { OnGap(table); }));
    for (const auto step :
         {&Salvage::MarkIncomplete, &Salvage::NameSessions, &Salvage::MarkSessionsWithoutRecords}) {
      if (failure_.ok()) failure_ = (this->*step)();
    }
    if (failure_.ok()) failure_ = transaction_->Commit();
    if (failure_.ok() && repair_.sessions == 0) {
      return absl::DataLossError(absl::StrCat(damaged_,
                                              ": expected sessions, received none that can "
                                              "be read: ",
                                              Describe(damage)));
    }
    return failure_;
  }

 private:
  absl::Status Open() {
    ASSIGN_OR_RETURN(transaction_, LmdbTransaction::Begin(target_));
    ASSIGN_OR_RETURN(const auto sessions, transaction_->OpenTable(kSessionsTable));
    ASSIGN_OR_RETURN(const auto records, transaction_->OpenTable(kRecordsTable));
    sessions_ = sessions;
    records_ = records;
    return absl::OkStatus();
  }

  void CopyKey(absl::string_view table, absl::string_view key, absl::string_view value) {
    const bool is_record = table == kRecordsTable;
    const size_t size = kStoredIdBytes + (is_record ? kNumberBytes : 0);
    if (!failure_.ok() || key.size() != size || (!is_record && table != kSessionsTable)) return;
    if (is_record) last_record_ = std::string(key);
    failure_ = transaction_->Put(is_record ? records_ : sessions_, key, value);
  }

  void OnGap(absl::string_view table) {
    if (table != kRecordsTable || last_record_.empty()) return;
    uint64_t number = 0;
    for (size_t i = kStoredIdBytes; i < last_record_.size(); ++i) {
      number = number << 8 | static_cast<uint8_t>(last_record_[i]);
    }
    ends_[last_record_.substr(0, kStoredIdBytes)] = number + 1;
  }

  // Puts a damaged record behind each journal that may lack its end, as a power cut leaves it.
  absl::Status MarkIncomplete() {
    for (const auto& entry : ends_) {
      const auto& id = entry.first;
      const uint64_t end = entry.second;
      RETURN_IF_ERROR(transaction_->Get(records_, StoredRecordKey(id, end)).status());
      // What follows was read, so what is missing lies between: the journal shows it.
      bool is_last = true;
      auto status = transaction_->Scan(records_, id, [&](absl::string_view key, absl::string_view) {
        is_last = is_last && key < StoredRecordKey(id, end);
      });
      if (status.ok() && is_last) {
        status = transaction_->Put(records_, StoredRecordKey(id, end), DamagedRecord());
      }
      if (!status.ok()) return status;
      ++repair_.incomplete;
    }
    return absl::OkStatus();
  }

  absl::Status MarkSessionsWithoutRecords() {
    std::vector<std::string> ids;
    auto status = transaction_->Scan(
        sessions_, "", [&](absl::string_view id, absl::string_view) { ids.emplace_back(id); });
    repair_.sessions = static_cast<int64_t>(ids.size());
    for (const std::string& id : ids) {
      if (!status.ok()) return status;
      ASSIGN_OR_RETURN(const auto records, Records(id));
      if (!records.empty()) continue;
      ++repair_.without;
      status = transaction_->Put(records_, StoredRecordKey(id, 0), DamagedRecord());
    }
    return status;
  }

  // A session whose description is lost has the tenant of its snapshot.
  absl::Status NameSessions() {
    std::map<std::string, std::vector<std::string>> keys;  // by session without a description
    absl::Status status =
        transaction_->Scan(records_, "", [&](absl::string_view key, absl::string_view) {
          const std::string id(key.substr(0, kStoredIdBytes));
          const auto known = transaction_->Get(sessions_, id);
          if (known.ok() && !known->has_value()) keys[id].emplace_back(key);
        });
    for (const auto& [id, own] : keys) {
      if (!status.ok()) return status;
      ASSIGN_OR_RETURN(auto records, Records(id));
      CutDamagedEnd(&records).IgnoreError();
      const auto journal = ParseJournal(records);
      if (journal.ok()) {
        const StoredSession session = {
            .tenant = journal->snapshot.options.tenant, .epoch = 1, .written_seconds = 0};
        status = transaction_->Put(sessions_, id, codec::Serialize(kStoredSessionFormat, session));
        continue;
      }
      ++repair_.unnamed;
      for (const std::string& key : own) {
        if (status.ok()) status = transaction_->Delete(records_, key);
      }
    }
    return status;
  }

  absl::StatusOr<std::vector<std::string>> Records(const std::string& id) {
    std::vector<std::string> records;
    RETURN_IF_ERROR(transaction_->Scan(
        records_, id,
        [&](absl::string_view, absl::string_view bytes) { records.push_back(OpenRecord(bytes)); }));
    return records;
  }

  const std::string damaged_;
  MDB_env* const target_;
  FileRepair& repair_;
  std::optional<LmdbTransaction> transaction_;
  MDB_dbi sessions_ = 0;
  MDB_dbi records_ = 0;
  std::string last_record_;  // key
  std::map<std::string, uint64_t>
      ends_;  // by session: behind its last record, which may be missing
  absl::Status failure_;
};

// Puts `from` in the place of `to`, whose file gets the name `kept` too. A crash leaves either.
absl::Status Replace(const std::string& directory, const std::string& from, const std::string& to,
                     const std::string& kept) {
  if (link(to.c_str(), kept.c_str()) != 0) return FileError(kept);
  if (rename(from.c_str(), to.c_str()) != 0) return FileError(to);
  const int folder = open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (folder < 0) return FileError(directory);
  const bool synced = fsync(folder) == 0;
  close(folder);
  return synced ? absl::OkStatus() : FileError(directory);
}

}  // namespace

absl::StatusOr<std::optional<FileRepair>> RepairFileStore(const std::string& directory) {
  const std::string file = absl::StrCat(directory, "/data.mdb");
  const std::string workshop = absl::StrCat(directory, "/repaired");
  std::error_code error;
  std::filesystem::remove_all(workshop, error);  // of a repair that was interrupted
  if (!std::filesystem::exists(file, error) || std::filesystem::file_size(file, error) == 0) {
    return std::nullopt;
  }
  ASSIGN_OR_RETURN(const auto damage,
                   ScanLmdbFile(
                       file, [](absl::string_view, absl::string_view, absl::string_view) {},
                       [](absl::string_view) {}));
  if (damage.empty()) return std::nullopt;

  FileRepair repair = {
      .damage = Describe(damage),
      .kept_as = absl::StrCat(file, ".damaged-", absl::ToUnixSeconds(absl::Now())),
  };
  std::filesystem::create_directory(workshop, error);
  {
    ASSIGN_OR_RETURN(auto target, OpenLmdb(workshop, kMostStoreBytes));
    if (auto status = Salvage(file, target.get(), &repair).Run(); !status.ok()) {
      std::filesystem::remove_all(workshop, error);
      return status;
    }
  }
  const auto status = Replace(directory, workshop + "/data.mdb", file, repair.kept_as);
  std::filesystem::remove_all(workshop, error);
  if (!status.ok()) return status;
  return repair;
}

}  // namespace spikeserve
