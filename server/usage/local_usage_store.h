// Keeps the ledger of one server in memory and, if it has a folder, in LMDB there.
//
// Books into memory first: if the disk takes nothing, what is not written yet is tried again with
// the next batch, and a crash loses it.
#pragma once

#include <map>
#include <memory>
#include <set>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "core/store/lmdb.h"
#include "server/base/file_descriptor.h"
#include "server/usage/usage_store.h"

namespace spikeserve {

// Thread-safe.
class LocalUsageStore final : public UsageStore {
 public:
  // Opens the ledger in `directory`, which is created if it does not exist; empty: memory alone.
  // INVALID_ARGUMENT if the folder cannot be used.
  static absl::StatusOr<std::unique_ptr<LocalUsageStore>> Open(const std::string& directory);

  // Returns how many decisions of a session were booked.
  double BookedDecisions(const std::string& session) ABSL_LOCKS_EXCLUDED(mutex_);

  absl::Status Book(const UsageBatch& batch) override;
  absl::StatusOr<std::map<std::string, UsageCounts>> MonthOf(absl::Time time) override;
  absl::StatusOr<std::vector<std::string>> Parts() override;
  absl::StatusOr<UsagePart> Read(const std::string& part) override;
  absl::Status Replace(const UsagePart& source, const UsagePart& target,
                       const std::string& packed) override;
  absl::Status Forget(absl::Time time) override;

 private:
  // The ledger as keys and values: `s/` with a session has its totals, `t/` with a month and a
  // tenant, and `o.../` with a series, have counts, and the other parts have packed rows.
  using Table = std::map<std::string, std::string>;

  LocalUsageStore() = default;
  absl::Status Load(const std::string& directory) ABSL_LOCKS_EXCLUDED(mutex_);
  void Set(const std::string& key, std::string value) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Remove(const std::string& key) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Add(const std::string& key, const UsageCounts& counts) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Adds what is new since the session was booked to `added`.
  void BookTotals(const UsageBatch& batch, const SessionTotals& session,
                  std::map<std::string, UsageCounts>* added) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  std::string RevisionOf(const std::string& part) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Writes what has changed to the disk.
  absl::Status Flush() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  FileDescriptor lock_;  // of the folder, so that no other server uses it
  absl::Mutex mutex_;
  Table table_ ABSL_GUARDED_BY(mutex_);
  std::map<std::string, uint64_t> revisions_ ABSL_GUARDED_BY(mutex_);  // of the parts
  std::map<std::string, size_t> series_ ABSL_GUARDED_BY(mutex_);       // of the open parts
  std::set<std::string> changed_ ABSL_GUARDED_BY(mutex_);  // keys, since the last Flush()
  LmdbEnvironment environment_ ABSL_GUARDED_BY(mutex_);    // null: memory alone
  MDB_dbi records_ ABSL_GUARDED_BY(mutex_) = 0;
};

}  // namespace spikeserve
