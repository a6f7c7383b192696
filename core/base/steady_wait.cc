#include "core/base/steady_wait.h"

#include <algorithm>
#include <chrono>

namespace spikeserve {
namespace {

// Lets std::condition_variable_any unlock and lock a mutex of Abseil.
class Lockable {
 public:
  explicit Lockable(absl::Mutex* mutex) : mutex_(*mutex) {}

  void lock() ABSL_NO_THREAD_SAFETY_ANALYSIS { mutex_.Lock(); }      // NOLINT: name of the library
  void unlock() ABSL_NO_THREAD_SAFETY_ANALYSIS { mutex_.Unlock(); }  // NOLINT: name of the library

 private:
  absl::Mutex& mutex_;
};

// The clock counts nanoseconds, so that a longer wait would overflow it.
constexpr absl::Duration kLongestWait = absl::Hours(24 * 365);

}  // namespace

bool SteadyCondition::Wait(absl::Mutex* mutex, absl::Duration timeout,
                           absl::FunctionRef<bool()> predicate) {
  Lockable lockable(mutex);
  const auto end =
      std::chrono::steady_clock::now() + absl::ToChronoNanoseconds(std::min(timeout, kLongestWait));
  return changed_.wait_until(lockable, end, predicate);
}

void SteadyNotification::Notify() {
  absl::MutexLock lock(&mutex_);
  notified_ = true;
  changed_.NotifyAll();
}

bool SteadyNotification::WaitFor(absl::Duration timeout) {
  absl::MutexLock lock(&mutex_);
  const auto notified = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return notified_; };
  return changed_.Wait(&mutex_, timeout, notified);
}

}  // namespace spikeserve
