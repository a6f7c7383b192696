#include "client/src/pilot/server_call.h"

#include <utility>

#include "absl/time/clock.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"

namespace spikeserve::piloting {

ServerCall::ServerCall(Replicas* replicas, Route* route, absl::Duration timeout,
                       std::function<void()> on_done)
    : replicas_(replicas),
      route_(route),
      timeout_(timeout),
      on_done_(std::move(on_done)),
      replica_(replicas->Choose(*route)),
      watched_(&replica_->connection, &context_, /*expects_answer=*/true) {
  context_.set_deadline(absl::ToChronoTime(absl::Now() + timeout));
  context_.AddMetadata(kAffinityKey, route->key);
}

ServerCall::~ServerCall() {
  context_.TryCancel();
  absl::MutexLock lock(&mutex_);
  mutex_.Await(absl::Condition(
      +[](bool* under_way) { return !*under_way; }, &is_under_way_));
}

std::function<void(grpc::Status)> ServerCall::Done() {
  absl::MutexLock begin(&mutex_);
  is_under_way_ = true;
  return [this](grpc::Status status) {
    // Await may not return before the status is here, and the object may not go before on_done.
    {
      absl::MutexLock lock(&mutex_);
      status_ = std::move(status);
    }
    on_done_();
    absl::MutexLock lock(&mutex_);
    is_under_way_ = false;
  };
}

absl::Status ServerCall::Await() {
  absl::Status status;
  {
    absl::MutexLock lock(&mutex_);
    mutex_.Await(absl::Condition(
        +[](bool* under_way) { return !*under_way; }, &is_under_way_));
    status = StatusFromGrpc(status_);
  }
  status = watched_.Note(status);
  if (status.ok()) {
    replicas_->Answered(*route_, *replica_);
  } else if (absl::IsDeadlineExceeded(status)) {
    replicas_->Failed(*replica_, timeout_);
  } else if (IsRetryable(status)) {
    replicas_->Failed(*replica_);
  }
  return status;
}

}  // namespace spikeserve::piloting
