#include "core/store/lmdb.h"

#include <cstdint>
#include <filesystem>
#include <system_error>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

MDB_val ToValue(absl::string_view bytes) {
  return {bytes.size(), const_cast<char*>(bytes.data())};  // LMDB does not write through it
}

absl::string_view ToView(const MDB_val& value) {
  return {static_cast<const char*>(value.mv_data), value.mv_size};
}

// Sizes of the file of an environment, in bytes.
struct FileSize {
  std::string path;
  uint64_t size = 0;
  uint64_t expected = 0;  // of the pages that LMDB has taken
};

absl::StatusOr<FileSize> SizeOf(MDB_env* environment, const std::string& directory) {
  MDB_envinfo info;
  MDB_stat stat;
  for (const int error : {mdb_env_info(environment, &info), mdb_env_stat(environment, &stat)}) {
    if (auto status = LmdbStatus(error); !status.ok()) return status;
  }
  FileSize file = {.path = directory + "/data.mdb"};
  std::error_code error;
  file.size = std::filesystem::file_size(file.path, error);
  if (error) return absl::UnavailableError(absl::StrCat(file.path, ": ", error.message()));
  file.expected = (uint64_t{info.me_last_pgno} + 1) * stat.ms_psize;
  return file;
}

struct CursorCloser {
  void operator()(MDB_cursor* cursor) const { mdb_cursor_close(cursor); }
};

}  // namespace

absl::Status LmdbStatus(int error) {
  if (error == 0) return absl::OkStatus();
  return absl::UnavailableError(absl::StrCat("session store: ", mdb_strerror(error)));
}

absl::StatusOr<LmdbEnvironment> OpenLmdb(const std::string& directory, size_t most_bytes) {
  MDB_env* raw = nullptr;
  if (auto status = LmdbStatus(mdb_env_create(&raw)); !status.ok()) return status;
  LmdbEnvironment environment(raw);
  for (const int error : {mdb_env_set_mapsize(raw, most_bytes), mdb_env_set_maxdbs(raw, 2),
                          mdb_env_open(raw, directory.c_str(), MDB_NOTLS, 0600)}) {
    if (auto status = LmdbStatus(error); !status.ok()) return status;
  }
  // LMDB maps the file, and to read behind its end would kill the process. If the end was cut off,
  // its pages are zeros now, which LMDB reports as MDB_CORRUPTED. The file may be shorter without
  // harm, too: LMDB does not write pages that one transaction has both taken and given back.
  const auto file = SizeOf(raw, directory);
  if (!file.ok()) return file.status();
  if (file->size < file->expected) {
    std::error_code error;
    std::filesystem::resize_file(file->path, file->expected, error);
    if (error) return absl::UnavailableError(absl::StrCat(file->path, ": ", error.message()));
  }
  return environment;
}

absl::StatusOr<LmdbEnvironment> OpenLmdbToRead(const std::string& directory) {
  MDB_env* raw = nullptr;
  if (auto status = LmdbStatus(mdb_env_create(&raw)); !status.ok()) return status;
  LmdbEnvironment environment(raw);
  for (const int error : {mdb_env_set_maxdbs(raw, 2),
                          mdb_env_open(raw, directory.c_str(), MDB_NOTLS | MDB_RDONLY, 0600)}) {
    if (auto status = LmdbStatus(error); !status.ok()) return status;
  }
  const auto file = SizeOf(raw, directory);
  if (!file.ok()) return file.status();
  if (file->size < file->expected) {
    return absl::DataLossError(absl::StrCat("expected at least ", file->expected, " bytes in ",
                                            file->path, ", received ", file->size,
                                            ": its end is missing"));
  }
  return environment;
}

absl::StatusOr<LmdbTransaction> LmdbTransaction::Begin(MDB_env* environment) {
  MDB_txn* transaction = nullptr;
  const int error = mdb_txn_begin(environment, nullptr, 0, &transaction);
  if (auto status = LmdbStatus(error); !status.ok()) return status;
  return LmdbTransaction(transaction, /*writes=*/true);
}

absl::StatusOr<LmdbTransaction> LmdbTransaction::BeginToRead(MDB_env* environment) {
  MDB_txn* transaction = nullptr;
  const int error = mdb_txn_begin(environment, nullptr, MDB_RDONLY, &transaction);
  if (auto status = LmdbStatus(error); !status.ok()) return status;
  return LmdbTransaction(transaction, /*writes=*/false);
}

absl::StatusOr<MDB_dbi> LmdbTransaction::OpenTable(const char* name) {
  MDB_dbi table = 0;
  const int error = mdb_dbi_open(transaction_.get(), name, writes_ ? MDB_CREATE : 0, &table);
  if (auto status = LmdbStatus(error); !status.ok()) return status;
  return table;
}

absl::StatusOr<std::optional<absl::string_view>> LmdbTransaction::Get(MDB_dbi table,
                                                                      absl::string_view key) {
  MDB_val key_value = ToValue(key);
  MDB_val value;
  const int error = mdb_get(transaction_.get(), table, &key_value, &value);
  if (error == MDB_NOTFOUND) return std::nullopt;
  if (auto status = LmdbStatus(error); !status.ok()) return status;
  return ToView(value);
}

absl::Status LmdbTransaction::Put(MDB_dbi table, absl::string_view key, absl::string_view value) {
  MDB_val key_value = ToValue(key);
  MDB_val bytes = ToValue(value);
  return LmdbStatus(mdb_put(transaction_.get(), table, &key_value, &bytes, 0));
}

absl::Status LmdbTransaction::Delete(MDB_dbi table, absl::string_view key) {
  MDB_val key_value = ToValue(key);
  const int error = mdb_del(transaction_.get(), table, &key_value, nullptr);
  return error == MDB_NOTFOUND ? absl::OkStatus() : LmdbStatus(error);
}

absl::Status LmdbTransaction::Scan(
    MDB_dbi table, absl::string_view prefix,
    const std::function<void(absl::string_view key, absl::string_view value)>& visit) {
  MDB_cursor* raw = nullptr;
  if (auto status = LmdbStatus(mdb_cursor_open(transaction_.get(), table, &raw)); !status.ok()) {
    return status;
  }
  const std::unique_ptr<MDB_cursor, CursorCloser> cursor(raw);
  MDB_val key = ToValue(prefix);
  MDB_val value;
  // An empty prefix is no key that LMDB can look for.
  int error = mdb_cursor_get(raw, &key, &value, prefix.empty() ? MDB_FIRST : MDB_SET_RANGE);
  for (; error == 0 && absl::StartsWith(ToView(key), prefix);
       error = mdb_cursor_get(raw, &key, &value, MDB_NEXT)) {
    visit(ToView(key), ToView(value));
  }
  return error == MDB_NOTFOUND ? absl::OkStatus() : LmdbStatus(error);
}

absl::Status LmdbTransaction::Commit() {
  return LmdbStatus(mdb_txn_commit(transaction_.release()));
}

}  // namespace spikeserve
