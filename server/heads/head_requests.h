// Queues what is to be appended to the log of a version's heads, with those who wait for it.
#ifndef SERVER_HEADS_HEAD_REQUESTS_H_
#define SERVER_HEADS_HEAD_REQUESTS_H_

#include <functional>
#include <memory>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "core/agent/head_log.h"
#include "core/base/steady_wait.h"
#include "server/heads/redis_head_log.h"

namespace spikeserve {

// Completion of a blocking append or read of the log.
struct HeadOperation {
  SteadyNotification done;
  absl::StatusOr<MergeOutcome> outcome;  // set before `done`
};

// One request. Not thread-safe.
struct HeadRequest {
  HeadAppend append;  // without bytes: the log is only read
  std::shared_ptr<FleetContribution> contribution = nullptr;
  std::shared_ptr<HeadOperation> operation = nullptr;
  bool is_sent = false;  // an attempt to append it may have succeeded
  bool is_in_log = false;
  bool is_new = false;  // this server has appended it

  bool IsToBeAppended() const { return !is_in_log && !append.bytes.empty(); }

  // Reports the outcome to those who wait for it.
  void OnMerged(const MergeOutcome& outcome) const;
  void OnError(const absl::Status& status) const;
};

// The requests for one log, in their order. Thread-safe.
class HeadRequests {
 public:
  // `wake` is called, without a lock, whenever there is something to take.
  explicit HeadRequests(std::function<void()> wake) : wake_(std::move(wake)) {}

  void Add(HeadRequest request) ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns the oldest requests, as many as are appended together.
  std::vector<HeadRequest> Take() ABSL_LOCKS_EXCLUDED(mutex_);
  // Puts requests that were taken before those that were added since.
  void PutBack(std::vector<HeadRequest> requests) ABSL_LOCKS_EXCLUDED(mutex_);

  bool empty() const ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  const std::function<void()> wake_;
  mutable absl::Mutex mutex_;
  std::vector<HeadRequest> requests_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve

#endif  // SERVER_HEADS_HEAD_REQUESTS_H_
