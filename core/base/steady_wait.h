// Waits with timeouts on the monotonic clock, so that a step of the time of day neither prolongs
// nor shortens a wait.
//
// Use these instead of the timeouts of absl::Mutex, absl::CondVar and absl::Notification: those of
// Abseil 20220623 end at a time of day, so that after a step of a day back they last a day longer.
#pragma once

#include <condition_variable>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

namespace spikeserve {

// A condition variable. Thread-safe.
//
//   absl::MutexLock lock(&mutex_);
//   changed_.Wait(&mutex_, absl::Seconds(1), [this] { return done_; });
class SteadyCondition {
 public:
  // Lets the waiting threads call their predicates again.
  void NotifyAll() { changed_.notify_all(); }

  // Unlocks `mutex`, waits until `predicate`, which is called with the lock, returns true or
  // `timeout` has passed, and locks it again. Returns the last result of `predicate`.
  bool Wait(absl::Mutex* mutex, absl::Duration timeout, absl::FunctionRef<bool()> predicate)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);

 private:
  std::condition_variable_any changed_;
};

// An event that happens once. Thread-safe.
class SteadyNotification {
 public:
  // Ends the waits of all threads, now and later.
  void Notify() ABSL_LOCKS_EXCLUDED(mutex_);

  // Waits until Notify() was called or `timeout` has passed. Returns true if it was called.
  bool WaitFor(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  absl::Mutex mutex_;
  SteadyCondition changed_;
  bool notified_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace spikeserve
