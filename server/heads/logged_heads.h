// Keeps the heads of one policy version equal to their log in Redis: appends entries to the log,
// and folds what the log has into the heads.
//
// Every entry has the digest of all entries up to it. If what the log has does not follow what was
// folded, the heads begin again from the snapshot and the entries since. If entries are missing
// there, too, the other servers are asked for a new snapshot, and the log is cut at the gap if none
// answers. If the store is behind the heads, because Redis has lost something, they are written
// again.
//
// Not thread-safe, except that heads() may be read at any time.
#ifndef SERVER_HEADS_LOGGED_HEADS_H_
#define SERVER_HEADS_LOGGED_HEADS_H_

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/agent/head_log.h"
#include "core/agent/served_policy.h"
#include "core/base/clock.h"
#include "core/store/redis_client.h"
#include "prometheus/labels.h"
#include "server/heads/head_log_metrics.h"
#include "server/heads/head_replica.h"
#include "server/heads/head_requests.h"
#include "server/heads/redis_head_log.h"

namespace spikeserve {

// What all logs of a server have in common.
struct HeadLogSettings {
  absl::Duration retention;  // how long Redis remembers that an entry is in a log
  int64_t replicas = 0;      // of Redis that must have an entry before it counts
  const Clock* clock = nullptr;
  HeadLogMetrics* metrics = nullptr;
};

class LoggedHeads {
 public:
  // A snapshot is stored after this many entries.
  static constexpr int64_t kEntriesPerSnapshot = 1000;

  // `settings` must outlive this object.
  LoggedHeads(const HeadLogSettings* settings, const ServedPolicy& served);

  const std::string& name() const { return name_; }  // of the version, for people
  const std::shared_ptr<TenantHeads>& heads() const { return replica_.heads(); }
  bool paused() const { return replica_.paused(); }
  // Returns true once the heads were taken from the log.
  bool has_joined() const { return has_joined_; }

  // Appends those of `requests` that are to be appended, and folds what the log has. After an error
  // some of them may be in the log. Returns UNAVAILABLE if Redis or the log cannot be used now.
  absl::Status Exchange(RedisClient& client, absl::Span<HeadRequest> requests);

  // Returns the outcome of a request after Exchange().
  MergeOutcome OutcomeOf(const HeadRequest& request) const;
  // Forgets the outcomes of the entries that were folded until now, except the last ones.
  void ForgetOutcomes() { outcomes_.clear(); }

 private:
  // Sends the requests and folds the answer. Returns true if all of them are in the log.
  absl::StatusOr<bool> AppendAndRead(RedisClient& client, absl::Span<HeadRequest> requests);
  absl::Status ReadOn(RedisClient& client);
  // Folds the entries of a tail into the heads. DATA_LOSS if they do not follow.
  absl::Status FoldTail(const LogTail& tail);
  // Begins again from the snapshot. `reason`: why; empty for a server that joins.
  absl::Status Reload(RedisClient& client, absl::string_view reason);
  absl::Status Rewrite(RedisClient& client, const HeadReplica& replica, const HeadPosition& end,
                       absl::string_view reason);
  // The stored log has a gap after what `whole` has folded, and ends at `end`.
  absl::Status MendGap(RedisClient& client, const HeadReplica& whole, const HeadPosition& end);
  absl::Status StoreSnapshotIfDue(RedisClient& client, bool has_appended);
  // Keeps the contributors of this server's sessions alive in the log.
  absl::Status KeepMembers(RedisClient& client);

  const HeadLogSettings& settings_;
  const std::string name_;
  const prometheus::Labels labels_;  // policy and version
  const HeadLogKeys keys_;
  HeadReplica replica_;
  bool has_joined_ = false;
  int64_t snapshot_number_ = 0;
  bool wants_snapshot_ = false;
  absl::Duration members_kept_;              // when
  std::optional<absl::Duration> gap_since_;  // the stored log has a gap
  // Of entries that were folded since ForgetOutcomes(), by session and episode.
  std::map<std::pair<std::string, int64_t>, MergeOutcome> outcomes_;
};

}  // namespace spikeserve

#endif  // SERVER_HEADS_LOGGED_HEADS_H_
