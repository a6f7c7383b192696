#include "server/heads/head_requests.h"

#include <cstddef>
#include <iterator>
#include <utility>

namespace spikeserve {
namespace {

// Entries that are appended together.
constexpr size_t kMostAppends = 16;

}  // namespace

void HeadRequest::OnMerged(const MergeOutcome& outcome) const {
  if (contribution != nullptr) contribution->OnMerged(outcome, is_new);
  if (operation == nullptr) return;
  operation->outcome = outcome;
  operation->done.Notify();
}

void HeadRequest::OnError(const absl::Status& status) const {
  if (contribution != nullptr) contribution->OnUnreachable(status);
  if (operation == nullptr) return;
  operation->outcome = status;
  operation->done.Notify();
}

void HeadRequests::Add(HeadRequest request) {
  {
    absl::MutexLock lock(&mutex_);
    requests_.push_back(std::move(request));
  }
  wake_();
}

std::vector<HeadRequest> HeadRequests::Take() {
  std::vector<HeadRequest> taken;
  {
    absl::MutexLock lock(&mutex_);
    taken = std::exchange(requests_, {});
    if (taken.size() <= kMostAppends) return taken;
    const auto first_later = taken.begin() + kMostAppends;
    requests_.assign(std::make_move_iterator(first_later), std::make_move_iterator(taken.end()));
    taken.erase(first_later, taken.end());
  }
  wake_();
  return taken;
}

void HeadRequests::PutBack(std::vector<HeadRequest> requests) {
  absl::MutexLock lock(&mutex_);
  std::move(requests_.begin(), requests_.end(), std::back_inserter(requests));
  requests_ = std::move(requests);
}

bool HeadRequests::empty() const {
  absl::MutexLock lock(&mutex_);
  return requests_.empty();
}

}  // namespace spikeserve
