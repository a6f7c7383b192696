// Reads a session store as it is, without changing it: for people who want to know whether it is
// sound. Servers may use the store meanwhile.
//
//   auto found = CheckFileStore("/var/lib/spikeserve/sessions");
//   if (found.ok() && found->damaged.empty()) ...
//
// Free functions without shared state; safe to call from many threads. They block, and return
// UNAVAILABLE if the store cannot be read.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/store/redis_options.h"

namespace spikeserve {

// A finding about one session, or one key of the store.
struct StoreFinding {
  std::string name;    // the session's id, or the key
  std::string reason;  // what is wrong
};

struct StoreReport {
  int64_t open = 0;       // sessions
  int64_t closed = 0;     // tombstones (Redis)
  int64_t owned = 0;      // open sessions whose owner is alive (Redis)
  int64_t ownerless = 0;  // open sessions that no living server owns; the next call claims them
  int64_t entries = 0;    // decisions after the last snapshots
  int64_t bytes = 0;      // of all journals
  std::vector<std::string> replicas;   // that are alive (Redis)
  std::vector<StoreFinding> damaged;   // sessions that could not be restored
  std::vector<StoreFinding> orphaned;  // parts without their session
  std::vector<std::string> warnings;   // what the settings of the store may lose (Redis)
};

// Returns OK if a server could restore session `id` of `tenant` from `records`, as far as this is
// known without the policy. Adds the entries after the last snapshot to `entries`.
absl::Status CheckJournal(absl::string_view id, absl::string_view tenant,
                          absl::Span<const std::string> records, int64_t* entries);

// Checks every journal. NOT_FOUND if there is no store in `directory`.
absl::StatusOr<StoreReport> CheckFileStore(const std::string& directory);
absl::StatusOr<StoreReport> CheckRedisStore(const RedisOptions& options);

// Calls `visit` with the id and the records of each open session whose owner is not alive: the
// whole journal, or only the snapshot with which it begins.
absl::Status VisitOwnerless(
    const RedisOptions& options, bool whole,
    absl::FunctionRef<void(const std::string& id, const std::vector<std::string>& records)> visit);

}  // namespace spikeserve
