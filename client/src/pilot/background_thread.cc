#include "client/src/pilot/background_thread.h"

#include <algorithm>
#include <chrono>

#include "client/src/lockable.h"
#include "client/src/steady_time.h"

namespace spikeserve::piloting {
namespace {

constexpr absl::Duration kLongestWait = absl::Seconds(1);

}  // namespace

BackgroundThread::~BackgroundThread() {
  std::thread thread;
  {
    absl::MutexLock lock(&mutex_);
    is_stopping_ = true;
    changed_.notify_all();
    thread = std::move(thread_);
  }
  if (thread.joinable()) thread.join();
}

void BackgroundThread::Add(Worker* member) {
  absl::MutexLock lock(&mutex_);
  member->has_ended_ = false;
  members_.push_back(member);
  if (!thread_.joinable()) thread_ = std::thread([this] { Run(); });
  changed_.notify_all();
}

void BackgroundThread::Wake(Worker* member) {
  absl::MutexLock lock(&mutex_);
  member->is_woken_ = true;
  if (is_waiting_) changed_.notify_all();
}

void BackgroundThread::AwaitEnd(const Worker* member) {
  absl::MutexLock lock(&mutex_);
  mutex_.Await(absl::Condition(&member->has_ended_));
}

void BackgroundThread::Run() {
  std::vector<Worker*> due;
  while (TakeDue(&due)) {
    for (Worker* const member : due) Note(member, member->Work());
  }
}

bool BackgroundThread::TakeDue(std::vector<Worker*>* due) {
  due->clear();
  absl::MutexLock lock(&mutex_);
  while (!is_stopping_) {
    const absl::Duration now = SteadyNow();
    absl::Duration next = now + kLongestWait;
    for (Worker* const member : members_) {
      if (!member->is_woken_ && now < member->due_) {
        next = std::min(next, member->due_);
        continue;
      }
      member->is_woken_ = false;
      due->push_back(member);
    }
    if (!due->empty()) return true;
    Lockable lockable(&mutex_);
    is_waiting_ = true;
    changed_.wait_for(lockable, absl::ToChronoNanoseconds(next - now));
    is_waiting_ = false;
  }
  return false;
}

void BackgroundThread::Note(Worker* member, std::optional<absl::Duration> due) {
  absl::MutexLock lock(&mutex_);
  if (due.has_value()) {
    member->due_ = *due;
    return;
  }
  std::erase(members_, member);
  member->has_ended_ = true;
}

}  // namespace spikeserve::piloting
