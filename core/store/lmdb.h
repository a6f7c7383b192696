// Wraps LMDB, an embedded store that survives crashes: owners of its handles, and errors as
// statuses.
//
//   auto transaction = LmdbTransaction::Begin(environment.get());
//   auto status = transaction->Put(table, key, value);
//   if (status.ok()) status = transaction->Commit();
//
// Not thread-safe: one thread uses an environment and its transactions.
#pragma once

#include <lmdb.h>

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

struct LmdbCloser {
  void operator()(MDB_env* environment) const { mdb_env_close(environment); }
};
using LmdbEnvironment = std::unique_ptr<MDB_env, LmdbCloser>;

// Returns OK for 0, and otherwise UNAVAILABLE with LMDB's description of the error, or DATA_LOSS if
// LMDB has met a damaged page.
absl::Status LmdbStatus(int error);

// Opens the environment in `directory`, to read while another process may write to it. Returns
// DATA_LOSS if the end of its file is missing.
absl::StatusOr<LmdbEnvironment> OpenLmdbToRead(const std::string& directory);

// Opens the environment in `directory`, which exists. It may grow to `most_bytes`, or to
// less where this process may not map as much, and have two named tables. If the end of its file is
// missing, reading the lost pages returns UNAVAILABLE.
absl::StatusOr<LmdbEnvironment> OpenLmdb(const std::string& directory, size_t most_bytes);

// Returns the bytes of the file in pages that nothing uses any more, which further writes take.
absl::StatusOr<size_t> FreeLmdbBytes(MDB_env* environment);

// A transaction that is rolled back unless Commit() is called. An assertion of LMDB, which fails at
// a damaged page, is DATA_LOSS; the transaction is of no further use then.
class LmdbTransaction {
 public:
  static absl::StatusOr<LmdbTransaction> Begin(MDB_env* environment);
  // Sees the state of now until it ends, whatever others write.
  static absl::StatusOr<LmdbTransaction> BeginToRead(MDB_env* environment);

  // Opens a table. A transaction that may write creates it if it does not exist.
  absl::StatusOr<MDB_dbi> OpenTable(const char* name);

  // Returns nullopt if there is no such key. The view is valid until the next write.
  absl::StatusOr<std::optional<absl::string_view>> Get(MDB_dbi table, absl::string_view key);
  absl::Status Put(MDB_dbi table, absl::string_view key, absl::string_view value);
  // Does nothing if there is no such key.
  absl::Status Delete(MDB_dbi table, absl::string_view key);
  // Returns how many keys there are.
  absl::StatusOr<int64_t> Count(MDB_dbi table);
  // Calls `visit` for the keys that begin with `prefix`, in ascending order. It must not write.
  absl::Status Scan(
      MDB_dbi table, absl::string_view prefix,
      const std::function<void(absl::string_view key, absl::string_view value)>& visit);

  // Returns when the changes are on the disk.
  absl::Status Commit();

 private:
  struct Aborter {
    void operator()(MDB_txn* transaction) const { mdb_txn_abort(transaction); }
  };
  LmdbTransaction(MDB_txn* transaction, bool writes) : transaction_(transaction), writes_(writes) {}

  std::unique_ptr<MDB_txn, Aborter> transaction_;
  bool writes_;
};

}  // namespace spikeserve
