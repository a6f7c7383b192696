// Makes Abseil's mutexes visible to the thread sanitizer.
//
// Debian's Abseil is built without the sanitizer, so that memory accesses that its mutexes order
// would be reported as races, in this project's code and in gRPC's. The definitions below replace
// those of the library for every caller in the process. Each calls the library's definition and
// reports to the sanitizer what was acquired or released.
//
// The library evaluates a condition on the thread that holds the mutex at that time: the waiting
// thread, or a thread that is unlocking and has already reported the release. Therefore every
// evaluation of a condition reports that the mutex is held.
//
// Linked into the programs of the `tsan` preset only.
#include <dlfcn.h>

#include "absl/synchronization/mutex.h"

extern "C" void __tsan_acquire(void* address);
extern "C" void __tsan_release(void* address);

namespace absl {
ABSL_NAMESPACE_BEGIN
namespace {

// Returns the library's definition of `symbol`, which the caller replaces.
template <class Function>
Function Next(const char* symbol) {
  return reinterpret_cast<Function>(dlsym(RTLD_NEXT, symbol));
}

// A condition whose evaluation is reported to the sanitizer as protected by `mutex`. Keeps a
// reference to `condition`.
class SeenCondition {
 public:
  SeenCondition(Mutex* mutex, const Condition& condition) : mutex_(mutex), condition_(condition) {}

  bool operator()() const {
    __tsan_acquire(mutex_);
    // Looked up at run time, because this file is also linked into programs without Abseil.
    static const auto eval = Next<bool (*)(const Condition&)>("_ZNK4absl7debian39Condition4EvalEv");
    const bool holds = eval(condition_);
    __tsan_release(mutex_);
    return holds;
  }

 private:
  Mutex* const mutex_;
  const Condition& condition_;
};

}  // namespace

// Returns the Itanium mangling of absl::<inline namespace>::<name>. Debian's inline namespace is
// debian3.
#define SPIKESERVE_ABSL(name) "_ZN4absl7debian3" name

void Mutex::Lock() {
  static const auto next = Next<void (*)(Mutex*)>(SPIKESERVE_ABSL("5Mutex4LockEv"));
  next(this);
  __tsan_acquire(this);
}

void Mutex::Unlock() {
  static const auto next = Next<void (*)(Mutex*)>(SPIKESERVE_ABSL("5Mutex6UnlockEv"));
  __tsan_release(this);
  next(this);
}

void Mutex::ReaderLock() {
  static const auto next = Next<void (*)(Mutex*)>(SPIKESERVE_ABSL("5Mutex10ReaderLockEv"));
  next(this);
  __tsan_acquire(this);
}

void Mutex::ReaderUnlock() {
  static const auto next = Next<void (*)(Mutex*)>(SPIKESERVE_ABSL("5Mutex12ReaderUnlockEv"));
  __tsan_release(this);
  next(this);
}

bool Mutex::TryLock() {
  static const auto next = Next<bool (*)(Mutex*)>(SPIKESERVE_ABSL("5Mutex7TryLockEv"));
  const bool locked = next(this);
  if (locked) __tsan_acquire(this);
  return locked;
}

void Mutex::Await(const Condition& condition) {
  static const auto next =
      Next<void (*)(Mutex*, const Condition&)>(SPIKESERVE_ABSL("5Mutex5AwaitERKNS0_9ConditionE"));
  const SeenCondition seen(this, condition);
  __tsan_release(this);
  next(this, Condition(&seen));
  __tsan_acquire(this);
}

bool Mutex::AwaitWithTimeout(const Condition& condition, Duration timeout) {
  static const auto next = Next<bool (*)(Mutex*, const Condition&, Duration)>(
      SPIKESERVE_ABSL("5Mutex16AwaitWithTimeoutERKNS0_9ConditionENS0_8DurationE"));
  const SeenCondition seen(this, condition);
  __tsan_release(this);
  const bool satisfied = next(this, Condition(&seen), timeout);
  __tsan_acquire(this);
  return satisfied;
}

bool Mutex::AwaitWithDeadline(const Condition& condition, Time deadline) {
  static const auto next = Next<bool (*)(Mutex*, const Condition&, Time)>(
      SPIKESERVE_ABSL("5Mutex17AwaitWithDeadlineERKNS0_9ConditionENS0_4TimeE"));
  const SeenCondition seen(this, condition);
  __tsan_release(this);
  const bool satisfied = next(this, Condition(&seen), deadline);
  __tsan_acquire(this);
  return satisfied;
}

void CondVar::Wait(Mutex* mutex) {
  static const auto next =
      Next<void (*)(CondVar*, Mutex*)>(SPIKESERVE_ABSL("7CondVar4WaitEPNS0_5MutexE"));
  __tsan_release(mutex);
  next(this, mutex);
  __tsan_acquire(mutex);
}

bool CondVar::WaitWithTimeout(Mutex* mutex, Duration timeout) {
  static const auto next = Next<bool (*)(CondVar*, Mutex*, Duration)>(
      SPIKESERVE_ABSL("7CondVar15WaitWithTimeoutEPNS0_5MutexENS0_8DurationE"));
  __tsan_release(mutex);
  const bool expired = next(this, mutex, timeout);
  __tsan_acquire(mutex);
  return expired;
}

bool CondVar::WaitWithDeadline(Mutex* mutex, Time deadline) {
  static const auto next = Next<bool (*)(CondVar*, Mutex*, Time)>(
      SPIKESERVE_ABSL("7CondVar16WaitWithDeadlineEPNS0_5MutexENS0_4TimeE"));
  __tsan_release(mutex);
  const bool expired = next(this, mutex, deadline);
  __tsan_acquire(mutex);
  return expired;
}

ABSL_NAMESPACE_END
}  // namespace absl
