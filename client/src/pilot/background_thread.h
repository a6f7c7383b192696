// The background thread of the pilots of one client: calls each member when it has work.
//
//   background.Add(&link);      // the thread calls link.Work()
//   background.Wake(&link);     // soon, after something has changed
//   background.AwaitEnd(&link); // until Work() has returned nothing
//
// Thread-safe.
#pragma once

#include <condition_variable>
#include <optional>
#include <thread>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

namespace spikeserve::piloting {

class BackgroundThread {
 public:
  class Worker {
   public:
    virtual ~Worker() = default;
    // Does all work that there is, without blocking for long. Returns when it is to be called again
    // if nobody wakes it before, by SteadyNow(), or nothing if it ends.
    virtual std::optional<absl::Duration> Work() = 0;

   private:
    friend class BackgroundThread;

    // Guarded by the mutex of the background.
    absl::Duration due_ = -absl::InfiniteDuration();
    bool is_woken_ = false;
    bool has_ended_ = true;
  };

  // The thread begins with the first member.
  BackgroundThread() = default;
  // REQUIRES: every member has ended.
  ~BackgroundThread();

  void Add(Worker* member) ABSL_LOCKS_EXCLUDED(mutex_);
  // Allocates no memory. Does nothing if the member has ended.
  void Wake(Worker* member) ABSL_LOCKS_EXCLUDED(mutex_);
  // Waits until the member has ended, or returns at once if it was never added.
  void AwaitEnd(const Worker* member) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  void Run() ABSL_LOCKS_EXCLUDED(mutex_);
  // Moves the members that have work to `due`, or waits for some. Returns false at the end.
  bool TakeDue(std::vector<Worker*>* due) ABSL_LOCKS_EXCLUDED(mutex_);
  // Notes what Work() has returned.
  void Note(Worker* member, std::optional<absl::Duration> due) ABSL_LOCKS_EXCLUDED(mutex_);

  absl::Mutex mutex_;
  // An absl::CondVar would measure its timeouts by the time of day.
  std::condition_variable_any changed_;
  std::vector<Worker*> members_ ABSL_GUARDED_BY(mutex_);
  bool is_waiting_ ABSL_GUARDED_BY(mutex_) = false;
  bool is_stopping_ ABSL_GUARDED_BY(mutex_) = false;
  std::thread thread_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve::piloting
