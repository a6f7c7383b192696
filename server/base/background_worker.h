// Runs long work on one thread, by default of lower priority than those that compute decisions.
// Work belongs to groups, such as tenants, which take turns: a group with much work does not delay
// that of the others. The queue of each group is bounded: work beyond it is refused.
//
// Thread-safe.
#pragma once

#include <cstddef>
#include <deque>
#include <functional>
#include <map>
#include <string>
#include <thread>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

class BackgroundWorker {
 public:
  enum class Priority { kLow, kNormal };

  // Bounds the queue of each group to `max_waiting` work items. The item that runs does not count.
  explicit BackgroundWorker(size_t max_waiting, Priority priority = Priority::kLow);

  // Blocks until all accepted work has run.
  ~BackgroundWorker();
  BackgroundWorker(const BackgroundWorker&) = delete;
  BackgroundWorker& operator=(const BackgroundWorker&) = delete;

  // Queues `work`, which runs once, after the earlier work of its group. Returns UNAVAILABLE if the
  // queue of the group is full; `work` then never runs.
  absl::Status Submit(const std::string& group, std::function<void()> work);
  // As above, in the group with the empty name.
  absl::Status Submit(std::function<void()> work) { return Submit("", std::move(work)); }

 private:
  void Run();
  // Removes and returns the first work of the group whose turn it is.
  std::function<void()> TakeNext() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const size_t max_waiting_;
  const Priority priority_;
  absl::Mutex mutex_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  // By group; only groups with work.
  std::map<std::string, std::deque<std::function<void()>>> waiting_ ABSL_GUARDED_BY(mutex_);
  std::deque<std::string> turns_ ABSL_GUARDED_BY(mutex_);  // the keys of `waiting_`, next first
  std::thread thread_;
};

}  // namespace spikeserve
