// The log of the heads of one policy version: appends entries to it, and keeps the heads equal to
// what it has in Redis.
//
// Every entry has the digest of all entries up to it. If what the log has does not follow what was
// folded, the heads begin again from the snapshot and the entries since. If entries are missing
// there, too, the other servers are asked for a new snapshot, and the log is cut at the gap if none
// answers. If the store is behind the heads, because Redis has lost something, they are written
// again.
#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/agent/head_log.h"
#include "core/agent/served_policy.h"
#include "core/base/clock.h"
#include "core/fleet/head_entry.h"
#include "core/fleet/head_fold.h"
#include "core/store/redis_client.h"
#include "prometheus/counter.h"
#include "server/heads/redis_head_log.h"

namespace spikeserve {

// What all logs of a server have in common. All members must outlive the logs.
struct HeadLogSettings {
  absl::Duration retention;  // how long Redis remembers that an entry is in a log
  int64_t replicas = 0;      // of Redis that must have an entry before it counts
  const Clock* clock = nullptr;
  // Entries that this server has appended, found in a log already, or taken into its heads:
  prometheus::Counter& appended;
  prometheus::Counter& known;
  prometheus::Counter& folded;
  // Times that a log did not go on from the heads of this server, which then took the stored heads,
  // stored its own, or gave up the entries after a gap:
  prometheus::Counter& reloaded;
  prometheus::Counter& rewritten;
  prometheus::Counter& cut;
};

// The methods of HeadLog are thread-safe: they queue a request, and wait for it if they have an
// outcome. The other methods are called by one thread, which serves the log.
class VersionLog final : public HeadLog {
 public:
  // `settings` must outlive the log. `wake` is called when the log has requests.
  VersionLog(const HeadLogSettings* settings, const ServedPolicy& served,
             std::function<void()> wake);

  std::shared_ptr<TenantHeads> heads() const override { return fold_.heads(); }
  void Append(std::shared_ptr<FleetContribution> contribution) override;
  absl::Status CatchUp() override;
  absl::StatusOr<double> Rollback(const std::string& tenant) override;
  absl::StatusOr<MergeOutcome> Undo(const std::string& tenant, const std::string& operator_id,
                                    absl::Duration ago) override;
  absl::Status SetPaused(bool paused) override;

  // Thread-safe, too.
  bool has_requests() const ABSL_LOCKS_EXCLUDED(mutex_);
  const std::string& policy() const { return policy_; }
  int64_t version() const { return version_; }
  // Returns the number of the last entry that was taken.
  int64_t position() const { return position_.load(std::memory_order_relaxed); }

  // Returns true once the heads were taken from the log.
  bool has_joined() const { return has_joined_; }
  // Returns whether a session on this server uses a head, as IsDue() has found out.
  bool is_used() const { return is_used_; }
  // Returns true if the log is to be served now: also when a session begins to use a head.
  bool IsDue();

  // Takes the oldest requests, unless it has, appends them, and folds what the log has. After an
  // error some of them may be in the log. Returns UNAVAILABLE if Redis or the log cannot be used
  // now. May be called again until Finish() or Fail().
  absl::Status Exchange(RedisClient& client);
  // The last Exchange() returned OK. Reports the outcomes. What a log does not take now that was
  // written again is tried again later. Without requests the log is due again after `pause`.
  // `follows`: this server knows the settings of operators at present; asks for an entry if the log
  // has missed a pause, or its end, that they have set some seconds ago.
  void Finish(absl::Duration pause, bool follows);
  // The log could not be served, because of `status`. Only requests that nobody waits for are tried
  // again later. `is_connected`: Redis could be reached before.
  void Fail(const absl::Status& status, bool is_connected);
  // Ends all requests with an error, because nothing will serve the log again.
  void Close(const absl::Status& status);

 private:
  struct Request {
    HeadEntry entry = {};
    std::string bytes = "";  // of `entry`; empty: the log is only read
    // Called with every outcome. `is_new`: this server has made the entry.
    std::function<void(const absl::StatusOr<MergeOutcome>& outcome, bool is_new)> done = nullptr;
    bool is_kept = false;  // after an error, to be tried again
    bool is_sent = false;  // an attempt to append it may have succeeded
    bool is_in_log = false;
    bool is_new = false;  // this server has appended it

    bool IsToBeAppended() const { return !is_in_log && !bytes.empty(); }
  };
  using Requests = std::deque<Request>;

  // Returns a request for an entry without a session.
  static Request NewRequest(HeadEntry::Kind kind, Contribution contribution = {});
  void Add(Request request) ABSL_LOCKS_EXCLUDED(mutex_);
  // Waits for the outcome of a request.
  absl::StatusOr<MergeOutcome> Do(Request request);
  void Take() ABSL_LOCKS_EXCLUDED(mutex_);
  // Puts requests that were taken before those that were added since.
  void PutBack(Requests requests) ABSL_LOCKS_EXCLUDED(mutex_);
  void CorrectPause(bool follows);

  // version_log_exchange.cc: what Exchange() does.

  void NoteInLog(Request& request, bool is_new);
  MergeOutcome OutcomeOf(const Request& request) const;
  // Sends the requests and folds the answer. Returns true if all of them are in the log, or wait
  // for it to settle.
  absl::StatusOr<bool> AppendAndRead(RedisClient& client);
  // Folds the entries of a tail into the heads. DATA_LOSS if they do not follow.
  absl::Status FoldTail(const StoredLog& tail);
  // Begins again from the snapshot. `reason`: why; empty for a server that joins.
  absl::Status Reload(RedisClient& client, absl::string_view reason);
  absl::Status Rewrite(RedisClient& client, const HeadFold& heads, const HeadPosition& end,
                       absl::string_view reason);
  // The stored log has a gap after what `whole` has folded, and ends at `end`.
  absl::Status MendGap(RedisClient& client, const HeadFold& whole, const HeadPosition& end);
  absl::Status StoreSnapshotIfDue(RedisClient& client);
  // Keeps the contributors of this server's sessions alive in the log.
  absl::Status KeepMembers(RedisClient& client);

  const HeadLogSettings& settings_;
  const std::string policy_;
  const int64_t version_;
  const std::string name_;  // of both, for people
  const std::shared_ptr<LearningSwitch> learning_;
  const std::function<void()> wake_;
  const RedisHeadLog redis_;
  std::atomic<int64_t> position_ = 0;

  mutable absl::Mutex mutex_;
  Requests requests_ ABSL_GUARDED_BY(mutex_);

  // Of the thread that serves the log, except that the heads may be read at any time.
  HeadFold fold_;
  bool has_joined_ = false;
  Requests taken_;  // until Finish() or Fail()
  int64_t snapshot_number_ = 0;
  bool wants_snapshot_ = false;
  bool is_used_ = false;
  absl::Duration use_noted_;  // when
  int failures_ = 0;          // since the log was read last, on a connection that was made
  absl::Duration read_at_;    // the next time without requests
  absl::Duration retry_at_;   // not before
  absl::Duration retry_delay_;
  absl::Duration members_kept_;                // when
  std::optional<absl::Duration> gap_since_;    // the stored log has a gap
  std::optional<absl::Duration> pause_since_;  // the log and the settings differ in the pause
};

}  // namespace spikeserve
