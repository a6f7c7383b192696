// Keeps the heads of all policy versions equal to those of the other servers, on a thread of its
// own: appends contributions and the actions of operators to the logs in Redis, and folds what the
// logs have into the heads.
//
// Every entry has the digest of all entries up to it. If what a server reads does not follow what
// it has folded, it begins again from the snapshot and the entries since. If entries are missing
// there, too, it asks the other servers for a new snapshot, and cuts the log at the gap if none
// answers. If the store is behind this server, because Redis has lost something, the server writes
// its heads again.
//
// Thread-safe, except Stop().
#ifndef SERVER_HEADS_HEAD_LOG_STORE_H_
#define SERVER_HEADS_HEAD_LOG_STORE_H_

#include <atomic>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/random/random.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/agent/head_log.h"
#include "core/base/clock.h"
#include "core/base/steady_wait.h"
#include "core/store/redis_client.h"
#include "core/store/redis_options.h"
#include "prometheus/counter.h"
#include "prometheus/registry.h"
#include "server/heads/head_replica.h"
#include "server/heads/redis_head_log.h"

namespace spikeserve {

class VersionLog;

class HeadLogStore final : public HeadLogs {
 public:
  // A snapshot is stored after this many entries.
  static constexpr int64_t kEntriesPerSnapshot = 1000;

  // Redis remembers for `retention` that an entry is in a log. Registers these metrics in
  // `registry`, which must outlive the store, as must `clock`:
  //   spikeserve_head_log_entries_total{outcome}: appended, known or folded
  //   spikeserve_head_log_reloads_total{outcome}: reloaded, rewritten or cut
  //   spikeserve_head_log_position{policy, version}
  HeadLogStore(RedisOptions options, absl::Duration retention, const Clock* clock,
               prometheus::Registry* registry);
  ~HeadLogStore() override;

  std::shared_ptr<HeadLog> Open(const ServedPolicy& served) override;

  // Returns true once the heads of all versions were taken from their logs.
  bool has_joined() const { return joined_.load(std::memory_order_acquire); }
  // Waits until has_joined(), for at most `timeout`.
  void WaitToJoin(absl::Duration timeout);

  // Tells whether this server follows the settings of operators at present. While it does, it
  // corrects a log that has missed a pause or its end.
  void SetFollowing(bool follows) { follows_.store(follows, std::memory_order_relaxed); }

  // Appends what waits, for at most `timeout`, and ends the thread. What comes later is dropped:
  // the server that claims the session appends it.
  void Stop(absl::Duration timeout);

 private:
  friend class VersionLog;
  struct Request;
  using Requests = std::vector<Request>;

  // Queues a request of `log`.
  void Add(VersionLog* log, Request request) ABSL_LOCKS_EXCLUDED(mutex_);

  void Run();
  // Waits for requests, or for the time to read the logs again. Returns false if the store stops
  // and nothing waits, or the time for it is over.
  bool Wait() ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns true if the store stops and the time for it is over.
  bool IsOver() ABSL_LOCKS_EXCLUDED(mutex_);
  // Finds out which logs a session of this server uses, and sets when the others are read next.
  void NoteUse(const std::vector<std::shared_ptr<VersionLog>>& logs);
  std::vector<std::shared_ptr<VersionLog>> Logs() ABSL_LOCKS_EXCLUDED(mutex_);
  Requests Take(VersionLog& log) ABSL_LOCKS_EXCLUDED(mutex_);
  // Appends the requests of a log and folds what it has.
  void Serve(VersionLog& log, Requests requests);
  absl::Status Exchange(VersionLog& log, Requests& requests);
  absl::Status Connect();
  // Sends the requests and folds the answer. Returns true if all of them are in the log.
  absl::StatusOr<bool> AppendAndRead(VersionLog& log, Requests& requests);
  absl::Status ReadOn(VersionLog& log);
  // Folds the entries of a tail into the heads. DATA_LOSS if they do not follow.
  absl::Status FoldTail(VersionLog& log, const LogTail& tail);
  // Begins again from the snapshot. `reason`: why; empty for a server that joins.
  absl::Status Reload(VersionLog& log, absl::string_view reason);
  absl::Status Rewrite(VersionLog& log, const HeadReplica& replica, const HeadPosition& end,
                       absl::string_view reason);
  // The stored log has a gap after what `whole` has folded, and ends at `end`.
  absl::Status MendGap(VersionLog& log, const HeadReplica& whole, const HeadPosition& end);
  absl::Status StoreSnapshotIfDue(VersionLog& log, bool has_appended);
  absl::Status KeepMembers(VersionLog& log);
  void CorrectPause(VersionLog& log);
  void Finish(VersionLog& log, Requests& requests);
  void Fail(VersionLog& log, Requests requests, const absl::Status& status);

  const RedisOptions options_;
  const absl::Duration retention_;
  const Clock* const clock_;
  prometheus::Counter& appended_;
  prometheus::Counter& known_;
  prometheus::Counter& folded_;
  prometheus::Counter& reloaded_;
  prometheus::Counter& rewritten_;
  prometheus::Counter& cut_;
  prometheus::Family<prometheus::Gauge>& positions_;
  std::atomic<bool> joined_ = false;
  std::atomic<bool> follows_ = false;
  std::unique_ptr<RedisClient> client_;  // of the thread
  absl::Duration use_noted_;             // when, of the thread
  absl::BitGen random_;                  // of the thread
  absl::Duration unused_interval_;       // of reading a log that no session uses, of the thread

  absl::Mutex mutex_;
  SteadyCondition changed_;  // requests, `stopping_` or `joined_`
  std::map<std::string, std::weak_ptr<VersionLog>> logs_ ABSL_GUARDED_BY(mutex_);  // by key
  bool has_requests_ ABSL_GUARDED_BY(mutex_) = false;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  absl::Duration stop_by_ ABSL_GUARDED_BY(mutex_);
  std::thread thread_;  // declared last, because it uses the members above
};

}  // namespace spikeserve

#endif  // SERVER_HEADS_HEAD_LOG_STORE_H_
