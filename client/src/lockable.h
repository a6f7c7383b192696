// Lets a condition variable of the standard library wait with a mutex of Abseil. A CondVar of
// Abseil would measure its timeouts by the time of day.
#pragma once

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

class Lockable {
 public:
  explicit Lockable(absl::Mutex* mutex) : mutex_(*mutex) {}

  void lock() ABSL_NO_THREAD_SAFETY_ANALYSIS { mutex_.Lock(); }      // NOLINT: name of the library
  void unlock() ABSL_NO_THREAD_SAFETY_ANALYSIS { mutex_.Unlock(); }  // NOLINT: name of the library

 private:
  absl::Mutex& mutex_;
};

}  // namespace spikeserve
