#include "core/store/lmdb.h"

#include <algorithm>
#include <cerrno>
#include <csetjmp>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <system_error>

#include "absl/functional/function_ref.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/store/stored_session.h"

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
    RETURN_IF_ERROR(LmdbStatus(error));
  }
  FileSize file = {.path = directory + "/data.mdb"};
  std::error_code error;
  file.size = std::filesystem::file_size(file.path, error);
  if (error) return absl::UnavailableError(absl::StrCat(file.path, ": ", error.message()));
  file.expected = (uint64_t{info.me_last_pgno} + 1) * stat.ms_psize;
  return file;
}

// Where to continue when an assertion of LMDB fails on this thread; null: nowhere.
thread_local std::jmp_buf* assertion_handler = nullptr;

void OnAssertion(MDB_env* /*environment*/, const char* /*message*/) {
  if (assertion_handler != nullptr) std::longjmp(*assertion_handler, 1);  // NOLINT(cert-err52-cpp)
}

// Returns what `call` does, or MDB_CORRUPTED if an assertion of LMDB fails in it. It must call LMDB
// and nothing else: what it has on the stack is not destroyed then.
int Contain(absl::FunctionRef<int()> call) {
  std::jmp_buf here;
  if (setjmp(here) != 0) {  // NOLINT(cert-err52-cpp): LMDB would end the process
    assertion_handler = nullptr;
    return MDB_CORRUPTED;
  }
  assertion_handler = &here;
  const int error = call();
  assertion_handler = nullptr;
  return error;
}

// Opens an environment with `flags` that may grow to `most_bytes`, or to a half, a quarter, ... of
// it, at least kLeastBytes, where this process may not map as much: an emulator and `ulimit -v`
// refuse it.
absl::StatusOr<LmdbEnvironment> Map(const std::string& directory, size_t most_bytes,
                                    unsigned flags) {
  constexpr size_t kLeastBytes = size_t{1} << 30;
  while (true) {
    MDB_env* raw = nullptr;
    RETURN_IF_ERROR(LmdbStatus(mdb_env_create(&raw)));
    LmdbEnvironment environment(raw);
    for (const int error : {mdb_env_set_assert(raw, OnAssertion),
                            mdb_env_set_mapsize(raw, most_bytes), mdb_env_set_maxdbs(raw, 2)}) {
      RETURN_IF_ERROR(LmdbStatus(error));
    }
    const int error = mdb_env_open(raw, directory.c_str(), MDB_NOTLS | flags, 0600);
    if (error == 0) return environment;
    if (error != ENOMEM || most_bytes / 2 < kLeastBytes) return LmdbStatus(error);
    most_bytes /= 2;
  }
}

struct CursorCloser {
  void operator()(MDB_cursor* cursor) const { mdb_cursor_close(cursor); }
};

}  // namespace

absl::Status LmdbStatus(int error) {
  if (error == 0) return absl::OkStatus();
  const bool is_damage = error == MDB_CORRUPTED || error == MDB_PAGE_NOTFOUND ||
                         error == MDB_INVALID || error == MDB_PANIC || error == MDB_BAD_TXN;
  if (is_damage) {
    return absl::DataLossError(absl::StrCat("session store: ", mdb_strerror(error)));
  }
  return absl::UnavailableError(absl::StrCat("session store: ", mdb_strerror(error)));
}

absl::StatusOr<LmdbEnvironment> OpenLmdb(const std::string& directory, size_t most_bytes) {
  absl::StatusOr<LmdbEnvironment> opened = Map(directory, most_bytes, /*flags=*/0);
  if (!opened.ok()) return opened;
  LmdbEnvironment environment = *std::move(opened);
  // LMDB maps the file, and to read behind its end would kill the process. If the end was cut off,
  // its pages are zeros now, which LMDB reports as MDB_CORRUPTED. The file may be shorter without
  // harm, too: LMDB does not write pages that one transaction has both taken and given back.
  ASSIGN_OR_RETURN(const auto file, SizeOf(environment.get(), directory));
  if (file.size < file.expected) {
    std::error_code error;
    std::filesystem::resize_file(file.path, file.expected, error);
    if (error) return absl::UnavailableError(absl::StrCat(file.path, ": ", error.message()));
  }
  return environment;
}

absl::StatusOr<LmdbEnvironment> OpenLmdbToRead(const std::string& directory) {
  absl::StatusOr<LmdbEnvironment> environment = Map(directory, kMostStoreBytes, MDB_RDONLY);
  if (!environment.ok()) return environment;
  ASSIGN_OR_RETURN(const auto file, SizeOf(environment->get(), directory));
  if (file.size < file.expected) {
    return absl::DataLossError(absl::StrCat("expected at least ", file.expected, " bytes in ",
                                            file.path, ", received ", file.size,
                                            ": its end is missing"));
  }
  return environment;
}

absl::StatusOr<size_t> FreeLmdbBytes(MDB_env* environment) {
  constexpr MDB_dbi kFreePages = 0;  // LMDB's table of lists, each of which begins with its length
  MDB_stat stat;
  RETURN_IF_ERROR(LmdbStatus(mdb_env_stat(environment, &stat)));
  ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::BeginToRead(environment));
  size_t pages = 0;
  const auto add = [&](absl::string_view, absl::string_view list) {
    size_t length = 0;
    std::memcpy(&length, list.data(), std::min(sizeof(length), list.size()));
    pages += length;
  };
  RETURN_IF_ERROR(transaction.Scan(kFreePages, "", add));
  return pages * stat.ms_psize;
}

absl::StatusOr<LmdbTransaction> LmdbTransaction::Begin(MDB_env* environment) {
  MDB_txn* transaction = nullptr;
  const int error = mdb_txn_begin(environment, nullptr, 0, &transaction);
  RETURN_IF_ERROR(LmdbStatus(error));
  return LmdbTransaction(transaction, /*writes=*/true);
}

absl::StatusOr<LmdbTransaction> LmdbTransaction::BeginToRead(MDB_env* environment) {
  MDB_txn* transaction = nullptr;
  const int error = mdb_txn_begin(environment, nullptr, MDB_RDONLY, &transaction);
  RETURN_IF_ERROR(LmdbStatus(error));
  return LmdbTransaction(transaction, /*writes=*/false);
}

absl::StatusOr<MDB_dbi> LmdbTransaction::OpenTable(const char* name) {
  MDB_dbi table = 0;
  const int error = Contain(
      [&] { return mdb_dbi_open(transaction_.get(), name, writes_ ? MDB_CREATE : 0, &table); });
  RETURN_IF_ERROR(LmdbStatus(error));
  return table;
}

absl::StatusOr<std::optional<absl::string_view>> LmdbTransaction::Get(MDB_dbi table,
                                                                      absl::string_view key) {
  MDB_val key_value = ToValue(key);
  MDB_val value;
  const int error = Contain([&] { return mdb_get(transaction_.get(), table, &key_value, &value); });
  if (error == MDB_NOTFOUND) return std::nullopt;
  RETURN_IF_ERROR(LmdbStatus(error));
  return ToView(value);
}

absl::Status LmdbTransaction::Put(MDB_dbi table, absl::string_view key, absl::string_view value) {
  MDB_val key_value = ToValue(key);
  MDB_val bytes = ToValue(value);
  return LmdbStatus(
      Contain([&] { return mdb_put(transaction_.get(), table, &key_value, &bytes, 0); }));
}

absl::Status LmdbTransaction::Delete(MDB_dbi table, absl::string_view key) {
  MDB_val key_value = ToValue(key);
  const int error =
      Contain([&] { return mdb_del(transaction_.get(), table, &key_value, nullptr); });
  return error == MDB_NOTFOUND ? absl::OkStatus() : LmdbStatus(error);
}

absl::StatusOr<int64_t> LmdbTransaction::Count(MDB_dbi table) {
  MDB_stat stat;
  const int error = Contain([&] { return mdb_stat(transaction_.get(), table, &stat); });
  RETURN_IF_ERROR(LmdbStatus(error));
  return static_cast<int64_t>(stat.ms_entries);
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
  const auto move = [&](MDB_cursor_op to) {
    return Contain([&] { return mdb_cursor_get(raw, &key, &value, to); });
  };
  int error = move(prefix.empty() ? MDB_FIRST : MDB_SET_RANGE);
  for (; error == 0 && absl::StartsWith(ToView(key), prefix); error = move(MDB_NEXT)) {
    visit(ToView(key), ToView(value));
  }
  return error == MDB_NOTFOUND ? absl::OkStatus() : LmdbStatus(error);
}

absl::Status LmdbTransaction::Commit() {
  bool is_done = false;
  const int error = Contain([&] {
    const int outcome = mdb_txn_commit(transaction_.get());
    is_done = true;
    return outcome;
  });
  // Also a commit that fails ends the transaction, but one that stops at an assertion does not.
  if (is_done) static_cast<void>(transaction_.release());
  return LmdbStatus(error);
}

}  // namespace spikeserve
