// One thread for work that may wait: it runs at a lower priority than the threads that decide, and
// refuses work rather than letting it pile up.
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
  // At most `max_waiting` pieces of work wait.
  explicit BackgroundWorker(size_t max_waiting);

  // Finishes all accepted work.
  ~BackgroundWorker();
  BackgroundWorker(const BackgroundWorker&) = delete;
  BackgroundWorker& operator=(const BackgroundWorker&) = delete;

  // Runs `work` once, later. UNAVAILABLE where too much is waiting; then it never runs.
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
