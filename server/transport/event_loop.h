// One thread that waits for sockets, timers and work from other threads.
//
//   auto loop = EventLoop::Create(&clock);
//   std::thread thread([&] { (*loop)->Run(); });
//   (*loop)->Post([] { ... });  // runs on the loop's thread
//   (*loop)->Stop();
//   thread.join();
//
// A turn of the loop handles what is ready: sockets, as far as a millisecond takes it, timers,
// posted work, and then the work that AtEndOfTurn() registered. Work that gathers over a turn, such
// as decisions and bytes to write, is done once at its end.
//
// Thread-safety: Post() and Stop() may be called from any thread, everything else only from the
// thread of Run(), or before Run() starts.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/contract/thread_checker.h"
#include "server/base/file_descriptor.h"

namespace spikeserve {

class EventLoop {
 public:
  // What waits for a file descriptor. A source may be destroyed only by DeleteLater().
  class Source {
   public:
    virtual ~Source() = default;
    // `events` are epoll's: EPOLLIN, EPOLLOUT, EPOLLHUP, EPOLLERR.
    virtual void OnReady(uint32_t events) = 0;
  };

  // Identifies a timer. A default-constructed one identifies none.
  using Timer = std::pair<absl::Duration, uint64_t>;

  // `clock` is monotonic and must outlive the loop. Returns RESOURCE_EXHAUSTED if the process may
  // not open another file descriptor.
  static absl::StatusOr<std::unique_ptr<EventLoop>> Create(const Clock* clock);

  // Runs turns until Stop().
  void Run();
  void Stop();

  // Runs `work` on the loop's thread, in the order of the calls. Work that is posted after Stop()
  // is destroyed with the loop and does not run.
  void Post(std::function<void()> work);

  // Calls `source` for `events` of `fd` until Unwatch(). Level-triggered. Returns
  // RESOURCE_EXHAUSTED if the system has no room for another watch.
  absl::Status Watch(int fd, uint32_t events, Source* source);
  void ChangeWatch(int fd, uint32_t events, Source* source);
  void Unwatch(int fd);

  // Runs `work` once after `delay`.
  Timer After(absl::Duration delay, std::function<void()> work);
  // Does nothing if the timer has run or `timer` identifies none.
  void Cancel(Timer timer) {
    thread_.AssertCurrent();
    timers_.erase(timer);
  }

  // Runs `work` at the end of every turn, after everything else, in the order of registration.
  void AtEndOfTurn(std::function<void()> work) {
    thread_.AssertCurrent();
    end_of_turn_.push_back(std::move(work));
  }

  // Destroys `source` at the end of the turn, when no event of it can be pending any more.
  void DeleteLater(std::unique_ptr<Source> source) {
    thread_.AssertCurrent();
    garbage_.push_back(std::move(source));
  }
  // Destroys what DeleteLater() was given since the last turn. REQUIRES: the loop does not run.
  void DeleteRest() {
    thread_.AssertCurrent();
    garbage_.clear();
  }

  // Returns the time at which the turn started, of the clock.
  absl::Duration now() const {
    thread_.AssertCurrent();
    return now_;
  }

  // Returns the thread that the objects of this loop are confined to: that of Run() while it runs.
  const ThreadChecker& thread() const { return thread_; }

 private:
  explicit EventLoop(const Clock* clock) : clock_(clock), now_(clock->Now()) {}

  int MillisecondsToWait() ABSL_EXCLUSIVE_LOCKS_REQUIRED(thread_);
  void RunTimers() ABSL_EXCLUSIVE_LOCKS_REQUIRED(thread_);
  void RunPosted() ABSL_EXCLUSIVE_LOCKS_REQUIRED(thread_);

  const Clock* const clock_;
  FileDescriptor epoll_;
  FileDescriptor wakeup_;  // an eventfd that ends the wait for events

  ThreadChecker thread_;
  absl::Duration now_ ABSL_GUARDED_BY(thread_);
  uint64_t next_timer_ ABSL_GUARDED_BY(thread_) = 1;
  std::map<Timer, std::function<void()>> timers_ ABSL_GUARDED_BY(thread_);
  std::vector<std::function<void()>> end_of_turn_ ABSL_GUARDED_BY(thread_);
  std::vector<std::unique_ptr<Source>> garbage_ ABSL_GUARDED_BY(thread_);

  absl::Mutex mutex_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  bool sleeping_ ABSL_GUARDED_BY(mutex_) = false;  // waits for events, and nothing was posted
  bool woken_ ABSL_GUARDED_BY(mutex_) = false;     // `wakeup_` is readable
  std::vector<std::function<void()>> posted_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
