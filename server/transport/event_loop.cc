#include "server/transport/event_loop.h"

#include <sys/epoll.h>
#include <sys/eventfd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <limits>
#include <utility>

#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

constexpr int kEventsPerWait = 256;

// A turn handles sockets for about this long. Then what was gathered is decided and sent before the
// other sockets are handled, so that a flood on some does not delay the answers of all.
constexpr absl::Duration kTurnTime = absl::Milliseconds(1);

}  // namespace

absl::StatusOr<std::unique_ptr<EventLoop>> EventLoop::Create(const Clock* clock) {
  auto loop = std::unique_ptr<EventLoop>(new EventLoop(clock));
  loop->epoll_ = FileDescriptor(epoll_create1(EPOLL_CLOEXEC));
  loop->wakeup_ = FileDescriptor(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
  if (!loop->epoll_.valid() || !loop->wakeup_.valid()) {
    return absl::ResourceExhaustedError("event loop: cannot open a file descriptor");
  }
  RETURN_IF_ERROR(loop->Watch(loop->wakeup_.get(), EPOLLIN, nullptr));
  return loop;
}

void EventLoop::Run() {
  thread_.Bind();
  thread_.AssertCurrent();
  std::array<epoll_event, kEventsPerWait> events;
  int ready = 0;
  int next = 0;  // of `events`, the first one that was not handled
  while (true) {
    bool sleeps = false;
    {
      absl::MutexLock lock(&mutex_);
      if (stopping_) break;
      sleeps = next >= ready && posted_.empty();
      sleeping_ = sleeps;
    }
    if (next >= ready) {
      const int timeout = sleeps ? MillisecondsToWait() : 0;
      ready = epoll_wait(epoll_.get(), events.data(), kEventsPerWait, timeout);
      next = 0;
    }
    now_ = clock_->Now();
    while (next < ready) {
      const epoll_event& event = events[next++];
      auto* source = static_cast<Source*>(event.data.ptr);
      if (source != nullptr) source->OnReady(event.events);
      if (clock_->Now() - now_ > kTurnTime) break;
    }
    RunTimers();
    RunPosted();
    for (const auto& work : end_of_turn_) work();
    for (int i = next; i < ready; ++i) {
      const auto is_source = [&](const auto& source) { return source.get() == events[i].data.ptr; };
      if (std::ranges::any_of(garbage_, is_source)) events[i].data.ptr = nullptr;
    }
    garbage_.clear();
  }
  thread_.Release();
}

void EventLoop::Stop() {
  absl::MutexLock lock(&mutex_);
  stopping_ = true;
  eventfd_write(wakeup_.get(), 1);
}

void EventLoop::Post(std::function<void()> work) {
  absl::MutexLock lock(&mutex_);
  posted_.push_back(std::move(work));
  if (!std::exchange(sleeping_, false)) return;  // the loop looks before it waits
  woken_ = true;
  eventfd_write(wakeup_.get(), 1);
}

absl::Status EventLoop::Watch(int fd, uint32_t events, Source* source) {
  thread_.AssertCurrent();
  epoll_event event = {.events = events, .data = {.ptr = source}};
  if (epoll_ctl(epoll_.get(), EPOLL_CTL_ADD, fd, &event) == 0) return absl::OkStatus();
  return absl::ResourceExhaustedError("event loop: cannot watch another file descriptor");
}

void EventLoop::ChangeWatch(int fd, uint32_t events, Source* source) {
  thread_.AssertCurrent();
  epoll_event event = {.events = events, .data = {.ptr = source}};
  epoll_ctl(epoll_.get(), EPOLL_CTL_MOD, fd, &event);
}

void EventLoop::Unwatch(int fd) {
  thread_.AssertCurrent();
  epoll_ctl(epoll_.get(), EPOLL_CTL_DEL, fd, nullptr);
}

EventLoop::Timer EventLoop::After(absl::Duration delay, std::function<void()> work) {
  thread_.AssertCurrent();
  const Timer timer = {clock_->Now() + delay, next_timer_++};
  timers_.emplace(timer, std::move(work));
  return timer;
}

int EventLoop::MillisecondsToWait() {
  if (timers_.empty()) return -1;
  const absl::Duration wait = timers_.begin()->first.first - clock_->Now();
  // Rounds up, so that a timer that is due in less than a millisecond does not spin.
  const int64_t milliseconds = absl::ToInt64Milliseconds(absl::Ceil(wait, absl::Milliseconds(1)));
  return static_cast<int>(std::clamp<int64_t>(milliseconds, 0, std::numeric_limits<int>::max()));
}

void EventLoop::RunTimers() {
  while (!timers_.empty() && timers_.begin()->first.first <= now_) {
    const auto timer = timers_.extract(timers_.begin());
    timer.mapped()();
  }
}

void EventLoop::RunPosted() {
  std::vector<std::function<void()>> posted;
  {
    absl::MutexLock lock(&mutex_);
    if (posted_.empty()) return;
    if (std::exchange(woken_, false)) {
      eventfd_t count = 0;
      eventfd_read(wakeup_.get(), &count);
    }
    posted.swap(posted_);
  }
  for (const auto& work : posted) work();
}

}  // namespace spikeserve
