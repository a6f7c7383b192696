// Where the ledger is kept: by hour and series what was used, and for each stored session what of
// it was booked.
//
// What a session has used follows from its journal, which has the totals of its life. Together with
// each sum, in the same transaction or script, the store keeps the totals that the sum has: booking
// adds the difference. Therefore it does not matter which server books a session, how often, or
// after which crash: each decision is in the sums once. What a process alone knows is numbered, so
// that a booking that is sent again adds nothing.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/store/redis_options.h"
#include "server/usage/usage_rows.h"

namespace spikeserve {

// The totals of a stored session.
struct SessionTotals {
  std::string session;  // id in the session store
  std::string series;
  UsageTotals totals = {};
};

// What one call books, all or nothing.
struct UsageBatch {
  std::string source;   // names the process
  uint64_t number = 0;  // of its batches, from 1; a batch that was booked is not booked again
  absl::Time time;
  std::map<std::string, UsageCounts> added = {};  // by series
  std::vector<SessionTotals> totals = {};
};

// A part of the ledger; see OpenPart().
struct UsagePart {
  std::string name;
  std::string revision = "";  // empty: the part does not exist
  std::vector<UsageRow> rows = {};
};

// Thread-safe. Methods may block, and return UNAVAILABLE if the store cannot be reached.
class UsageStore {
 public:
  virtual ~UsageStore() = default;

  virtual absl::Status Book(const UsageBatch& batch) = 0;

  // Returns the sums of the tenants in the month of `time`.
  virtual absl::StatusOr<std::map<std::string, UsageCounts>> MonthOf(absl::Time time) = 0;

  // Returns the names of all parts, sorted.
  virtual absl::StatusOr<std::vector<std::string>> Parts() = 0;
  virtual absl::StatusOr<UsagePart> Read(const std::string& part) = 0;
  // Puts the packed rows in the place of `target`, and removes `source`. Does nothing, and returns
  // OK, if one of them has another revision by now.
  virtual absl::Status Replace(const UsagePart& source, const UsagePart& target,
                               const std::string& packed) = 0;

  // Forgets the totals of sessions that were not booked for so long, by the clock by which the
  // session store's journals get older: a time of day that is wrong makes nothing older.
  virtual absl::Status Forget(absl::Duration unused) = 0;
};

// Keeps the ledger of one server in memory and, if it has a folder, in LMDB there.
//
// Books into memory first: if the disk takes nothing, what is not written yet is tried again with
// the next batch, and a crash loses it.
class LocalUsageStore : public UsageStore {
 public:
  // Opens the ledger in `directory`, which is created if it does not exist; empty: memory alone.
  // `clock`, which must outlive the store, is the time that passes; null: that of the machine.
  // INVALID_ARGUMENT if the folder cannot be used.
  static absl::StatusOr<std::unique_ptr<LocalUsageStore>> Open(const std::string& directory,
                                                               const Clock* clock = nullptr);

  // Returns how many decisions of a session were booked.
  virtual double BookedDecisions(const std::string& session) = 0;
  // Forgets the totals of all other sessions, which the session store has no more.
  virtual absl::Status ForgetAllBut(const std::set<std::string>& sessions) = 0;
};

// Keeps the ledger of all servers that share a Redis. Methods block for at most a few
// RedisOptions::timeout.
std::unique_ptr<UsageStore> NewRedisUsageStore(RedisOptions options);

// Returns the rows that begin in [from, to).
absl::StatusOr<std::vector<UsageRow>> ReadUsage(UsageStore& store, absl::Time from, absl::Time to);

// Moves the rows of each part that is old enough to its target.
absl::Status CompactUsage(UsageStore& store, absl::Time now);

}  // namespace spikeserve
