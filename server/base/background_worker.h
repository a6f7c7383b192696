// Runs long work on one thread of lower priority than the threads that compute decisions. The queue
// is bounded: work beyond it is refused.
//
// Thread-safe.
#ifndef SERVER_BASE_BACKGROUND_WORKER_H_
#define SERVER_BASE_BACKGROUND_WORKER_H_

#include <deque>
#include <functional>
#include <thread>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

class BackgroundWorker {
 public:
  // Bounds the queue to `max_waiting` work items. The item that runs does not count.
  explicit BackgroundWorker(size_t max_waiting);

  // Blocks until all accepted work has run.
  ~BackgroundWorker();
  BackgroundWorker(const BackgroundWorker&) = delete;
  BackgroundWorker& operator=(const BackgroundWorker&) = delete;

  // Queues `work`, which runs once. Returns UNAVAILABLE if the queue is full; `work` then never
  // runs.
  absl::Status Submit(std::function<void()> work);

 private:
  void Run();

  const size_t max_waiting_;
  absl::Mutex mutex_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  std::deque<std::function<void()>> waiting_ ABSL_GUARDED_BY(mutex_);
  std::thread thread_;
};

}  // namespace spikeserve

#endif  // SERVER_BASE_BACKGROUND_WORKER_H_
