#include "server/base/background_worker.h"

#include <sys/resource.h>
#include <unistd.h>

#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr int kNice = 10;

}  // namespace

BackgroundWorker::BackgroundWorker(size_t max_waiting)
    : max_waiting_(max_waiting), thread_([this] { Run(); }) {}

BackgroundWorker::~BackgroundWorker() {
  {
    absl::MutexLock lock(&mutex_);
    stopping_ = true;
  }
  thread_.join();
}

absl::Status BackgroundWorker::Submit(std::function<void()> work) {
  absl::MutexLock lock(&mutex_);
  if (waiting_.size() >= max_waiting_) {
    return absl::UnavailableError(absl::StrCat("overloaded: expected fewer than ", max_waiting_,
                                               " waiting requests; ask again later"));
  }
  waiting_.push_back(std::move(work));
  return absl::OkStatus();
}

void BackgroundWorker::Run() {
  // On Linux, PRIO_PROCESS with a thread id sets the priority of that thread alone.
  setpriority(PRIO_PROCESS, static_cast<id_t>(gettid()), kNice);
  absl::MutexLock lock(&mutex_);
  while (true) {
    const auto due = [this]() ABSL_SHARED_LOCKS_REQUIRED(mutex_) {
      return stopping_ || !waiting_.empty();
    };
    mutex_.Await(absl::Condition(&due));
    if (waiting_.empty()) return;
    const std::function<void()> work = std::move(waiting_.front());
    waiting_.pop_front();
    mutex_.Unlock();
    work();
    mutex_.Lock();
  }
}

}  // namespace spikeserve
