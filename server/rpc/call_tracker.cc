#include "server/rpc/call_tracker.h"

#include <vector>

namespace spikeserve {

absl::Status DrainingError() {
  return absl::UnavailableError("draining: the server is stopping; call another server");
}

bool CallTracker::Begin() {
  absl::MutexLock lock(&mutex_);
  ++calls_;
  return !draining_;
}

bool CallTracker::BeginStream(const std::shared_ptr<Stream>& stream) {
  absl::MutexLock lock(&mutex_);
  ++calls_;
  streams_.emplace(stream.get(), stream);
  return !draining_;
}

void CallTracker::End() {
  absl::MutexLock lock(&mutex_);
  --calls_;
}

void CallTracker::EndStream(const Stream* stream) {
  absl::MutexLock lock(&mutex_);
  --calls_;
  streams_.erase(stream);
}

void CallTracker::Drain() {
  std::vector<std::shared_ptr<Stream>> open;
  {
    absl::MutexLock lock(&mutex_);
    draining_ = true;
    for (const auto& [key, stream] : streams_) {
      if (auto alive = stream.lock()) open.push_back(std::move(alive));
    }
  }
  for (const auto& stream : open) stream->Drain();
}

bool CallTracker::WaitUntilIdle(absl::Duration timeout) {
  absl::MutexLock lock(&mutex_);
  const auto idle = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return calls_ == 0; };
  return mutex_.AwaitWithTimeout(absl::Condition(&idle), timeout);
}

}  // namespace spikeserve
