// The thread that an object is confined to, as a capability that both clang's thread-safety
// analysis and, in builds without NDEBUG, a check at run time know.
//
//   class Queue {
//    public:
//     void Add(int n) { thread_->AssertCurrent(); items_.push_back(n); }
//    private:
//     const ThreadChecker* const thread_;
//     std::vector<int> items_ ABSL_GUARDED_BY(*thread_);
//   };
//
// The owner of the thread, such as an event loop, has the checker; the objects that live on the
// thread refer to it.
//
// Thread-safety: every method may be called from any thread.
#pragma once

#include <atomic>
#include <thread>

#include "absl/base/thread_annotations.h"
#include "core/contract/dcheck.h"

namespace spikeserve {

class ABSL_LOCKABLE ThreadChecker {
 public:
  ThreadChecker() = default;
  ThreadChecker(const ThreadChecker&) = delete;
  ThreadChecker& operator=(const ThreadChecker&) = delete;

  // Confines to the calling thread until Release(). REQUIRES: no thread is bound.
  void Bind() {
    const std::thread::id before = thread_.exchange(std::this_thread::get_id());
    SPIKESERVE_DCHECK(before == std::thread::id());
  }

  // Ends the confinement, for example because the thread will not run again and another one
  // destroys the objects. REQUIRES: the calling thread is bound.
  void Release() {
    const std::thread::id before = thread_.exchange(std::thread::id());
    SPIKESERVE_DCHECK(before == std::this_thread::get_id());
  }

  // Returns whether the caller may use what is confined: it runs on the bound thread, or no thread
  // is bound, so that nothing runs at the same time.
  bool IsCurrent() const {
    const std::thread::id bound = thread_.load();
    return bound == std::thread::id() || bound == std::this_thread::get_id();
  }

  // Aborts in debug builds unless IsCurrent(). Tells the analysis that the capability is held.
  void AssertCurrent() const ABSL_ASSERT_EXCLUSIVE_LOCK() { SPIKESERVE_DCHECK(IsCurrent()); }

 private:
  std::atomic<std::thread::id> thread_ = std::thread::id();  // the default id: none
};

}  // namespace spikeserve
