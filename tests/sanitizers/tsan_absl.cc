// Lets the thread sanitizer see Abseil's mutexes.
//
// Debian's Abseil is built without the sanitizer, so what its mutexes order would look like a race,
// in our code and in gRPC's. These definitions stand in front of the library's, for every caller in
// the process: each calls the library's own and tells the sanitizer what was acquired or released.
// A condition is evaluated within the library, by whichever thread holds the mutex then: by the one
// that waits, or by one that unlocks, after it has told the sanitizer so. So every evaluation says
// for itself that the mutex is held.
// Linked into the programs of the `tsan` preset only.
#include <dlfcn.h>

#include "absl/synchronization/mutex.h"

extern "C" void __tsan_acquire(void* address);
extern "C" void __tsan_release(void* address);

namespace absl {
ABSL_NAMESPACE_BEGIN
namespace {

// The library's definition of the symbol that the caller stands in front of.
template <class Function>
Function Next(const char* symbol) {
  return reinterpret_cast<Function>(dlsym(RTLD_NEXT, symbol));
}

// A condition whose evaluation the sanitizer sees under `mutex`; refers to `condition`.
class SeenCondition {
 public:
  SeenCondition(Mutex* mutex, const Condition& condition) : mutex_(mutex), condition_(condition) {}

  bool operator()() const {
    __tsan_acquire(mutex_);
    // Looked up, as programs are linked with this file that have no Abseil.
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

// Itanium mangling of absl::<inline namespace>::<name>; Debian calls the inline namespace debian3.
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
