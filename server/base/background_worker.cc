#include "server/base/background_worker.h"

#include <pthread.h>
#include <sys/resource.h>
#include <unistd.h>

#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr int kNice = 10;

}  // namespace

BackgroundWorker::BackgroundWorker(size_t max_waiting, Priority priority)
    : max_waiting_(max_waiting), priority_(priority), thread_([this] { Run(); }) {}

BackgroundWorker::~BackgroundWorker() {
  {
    absl::MutexLock lock(&mutex_);
    stopping_ = true;
  }
  thread_.join();
}

absl::Status BackgroundWorker::Submit(const std::string& group, std::function<void()> work) {
  absl::MutexLock lock(&mutex_);
  const auto found = waiting_.find(group);
  if (found != waiting_.end() && found->second.size() >= max_waiting_) {
    return absl::UnavailableError(absl::StrCat("overloaded: expected fewer than ", max_waiting_,
                                               " waiting requests; ask again later"));
  }
  if (found == waiting_.end()) turns_.push_back(group);
  waiting_[group].push_back(std::move(work));
  return absl::OkStatus();
}

std::function<void()> BackgroundWorker::TakeNext() {
  const auto group = waiting_.find(turns_.front());
  turns_.pop_front();
  std::function<void()> work = std::move(group->second.front());
  group->second.pop_front();
  if (group->second.empty()) {
    waiting_.erase(group);
  } else {
    turns_.push_back(group->first);
  }
  return work;
}

void BackgroundWorker::Run() {
  pthread_setname_np(pthread_self(), "worker");  // for those who look at the threads of the process
  // On Linux, PRIO_PROCESS with a thread id sets the priority of that thread alone.
  if (priority_ == Priority::kLow) setpriority(PRIO_PROCESS, static_cast<id_t>(gettid()), kNice);
  absl::MutexLock lock(&mutex_);
  while (true) {
    const auto due = [this]() ABSL_SHARED_LOCKS_REQUIRED(mutex_) {
      return stopping_ || !waiting_.empty();
    };
    mutex_.Await(absl::Condition(&due));
    if (waiting_.empty()) return;
    std::function<void()> work = TakeNext();
    mutex_.Unlock();
    work();
    work = nullptr;  // frees what it holds outside of the lock
    mutex_.Lock();
  }
}

}  // namespace spikeserve
