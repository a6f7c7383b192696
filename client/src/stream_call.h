// One call of ActStream, whose replies wait until they are asked for.
//
// Thread-safe.
#pragma once

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <deque>
#include <optional>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "client/src/action_stream.h"
#include "client/src/connection.h"
#include "client/src/lockable.h"
#include "client/src/replicas.h"
#include "client/src/steady_time.h"

namespace spikeserve {

class StreamCall final : private ActionStream::Listener {
 public:
  struct Incoming {
    v1::ActResponse response;
    std::chrono::steady_clock::time_point arrived;
  };

  // A fresh line of `connection`, which must outlive the call, cancels the call.
  StreamCall(RenewableConnection* connection, const Route& route)
      : stream_(connection, route, this) {}

  // Queues one request. Returns the status of the call if it has ended.
  absl::Status Send(const v1::ActRequest& request) ABSL_LOCKS_EXCLUDED(mutex_) {
    if (stream_.Send(request)) return absl::OkStatus();
    absl::MutexLock lock(&mutex_);
    if (final_status_.has_value() && !final_status_->ok()) return *final_status_;
    return absl::UnavailableError("the stream has ended");
  }

  // Declares that no more requests follow.
  void CloseSend() { stream_.CloseSend(); }

  // Returns the next response, or nothing if none arrives until `deadline` of SteadyNow(). After
  // the call has ended and all responses were returned: its status, or OUT_OF_RANGE if that is OK.
  std::optional<absl::StatusOr<Incoming>> Receive(absl::Duration deadline)
      ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    Lockable lockable(&mutex_);
    const absl::Duration wait = std::min(deadline - SteadyNow(), kLongestWait);
    const auto end = std::chrono::steady_clock::now() + absl::ToChronoNanoseconds(wait);
    while (responses_.empty() && !final_status_.has_value()) {
      if (std::chrono::steady_clock::now() >= end) return std::nullopt;
      changed_.wait_until(lockable, end);
    }
    if (responses_.empty()) {
      return final_status_->ok() ? absl::OutOfRangeError("the stream has ended") : *final_status_;
    }
    Incoming incoming = std::move(responses_.front());
    responses_.pop_front();
    return incoming;
  }

 private:
  void OnReply(v1::ActResponse&& reply) override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    responses_.push_back({std::move(reply), std::chrono::steady_clock::now()});
    changed_.notify_one();
  }

  void OnEnd(const absl::Status& status) override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    final_status_ = status;
    changed_.notify_all();
  }

  // The clock counts nanoseconds, so that a later time would overflow it.
  static constexpr absl::Duration kLongestWait = absl::Hours(24 * 365);

  absl::Mutex mutex_;
  // Notified when a response arrives or the call ends. A CondVar of Abseil would measure its
  // timeouts by the time of day.
  std::condition_variable_any changed_;
  std::deque<Incoming> responses_ ABSL_GUARDED_BY(mutex_);
  std::optional<absl::Status> final_status_ ABSL_GUARDED_BY(mutex_);
  ActionStream stream_;  // ends before what its calls of this object use
};

}  // namespace spikeserve
