// Keeps the heads of all policy versions equal to those of the other servers, on a thread of its
// own, which serves the logs of the versions over one connection to Redis.
//
// Thread-safe, except Stop().
#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/random/random.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/agent/head_log.h"
#include "core/base/clock.h"
#include "core/base/steady_wait.h"
#include "core/store/redis_client.h"
#include "core/store/redis_options.h"
#include "prometheus/registry.h"
#include "server/heads/version_log.h"

namespace spikeserve {

class HeadLogStore {
 public:
  // Redis remembers for `retention` that an entry is in a log. Registers metrics in `registry`,
  // which must outlive the store, as must `clock`.
  HeadLogStore(RedisOptions options, absl::Duration retention, const Clock* clock,
               prometheus::Registry* registry);
  ~HeadLogStore();

  // See OpenHeadLog.
  std::shared_ptr<HeadLog> Open(const ServedPolicy& served);

  // Returns true once the heads of all versions were taken from their logs.
  bool has_joined() const { return joined_.load(std::memory_order_acquire); }
  // Waits until has_joined(), for at most `timeout`.
  void WaitToJoin(absl::Duration timeout);

  // Tells whether this server follows the settings of operators at present: not before it has
  // loaded all of its versions. While it does, it corrects a log that has missed a pause or its
  // end.
  void SetFollowing(bool follows) {
    if (!follows_.exchange(follows, std::memory_order_acq_rel) && follows) Wake();
  }

  // Returns the number of the last entry that was taken, by policy and version: of the versions
  // that are served or have sessions.
  std::map<std::pair<std::string, int64_t>, int64_t> Positions() ABSL_LOCKS_EXCLUDED(mutex_);

  // Appends what waits, for at most `timeout`, and ends the thread. What comes later is dropped:
  // the server that claims the session appends it.
  void Stop(absl::Duration timeout);

 private:
  using Logs = std::vector<std::shared_ptr<VersionLog>>;

  // Makes the thread look at the logs.
  void Wake() ABSL_LOCKS_EXCLUDED(mutex_);
  void Run();
  // Waits for requests, or for the time to read the logs again. Returns false if the store stops
  // and nothing waits, or the time for it is over.
  bool Wait() ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns true if the store stops and the time for it is over.
  bool IsOver() ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns the logs of the versions that are still served.
  Logs OpenLogs() ABSL_LOCKS_EXCLUDED(mutex_);
  absl::Status Connect();
  void Serve(VersionLog& log);

  const RedisOptions options_;
  const HeadLogSettings settings_;
  std::atomic<bool> joined_ = false;
  std::atomic<bool> follows_ = false;
  std::unique_ptr<RedisClient> client_;  // of the thread
  absl::BitGen random_;                  // of the thread
  absl::Duration unused_interval_;       // of reading a log that no session uses, of the thread

  absl::Mutex mutex_;
  SteadyCondition changed_;  // `is_awake_`, `stopping_` or `joined_`
  std::map<std::string, std::weak_ptr<VersionLog>> logs_ ABSL_GUARDED_BY(mutex_);  // by key
  bool is_awake_ ABSL_GUARDED_BY(mutex_) = false;  // there is something to do
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  absl::Duration stop_by_ ABSL_GUARDED_BY(mutex_);
  std::thread thread_;  // declared last, because it uses the members above
};

}  // namespace spikeserve
