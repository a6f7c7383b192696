#include "client/src/stream_call.h"

#include <algorithm>
#include <utility>

#include "client/src/lockable.h"
#include "client/src/steady_time.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

// The clock counts nanoseconds, so that a later time would overflow it.
constexpr absl::Duration kLongestWait = absl::Hours(24 * 365);

}  // namespace

StreamCall::StreamCall(RenewableConnection* connection, const Route& route)
    : watched_(connection, &context_, /*expects_answer=*/false) {
  context_.AddMetadata(kAffinityKey, route.key);
  watched_.line().stub->async()->ActStream(&context_, this);
  // Writes start outside of gRPC's callbacks. The hold keeps gRPC from ending the call before them.
  AddHold();
  StartRead(&incoming_);
  StartCall();
}

StreamCall::~StreamCall() {
  context_.TryCancel();
  absl::MutexLock lock(&mutex_);
  Lockable lockable(&mutex_);
  while (!final_status_.has_value()) changed_.wait(lockable);
}

absl::Status StreamCall::Send(const v1::ActRequest& request) {
  absl::MutexLock lock(&mutex_);
  if (final_status_.has_value() && !final_status_->ok()) return *final_status_;
  if (read_ended_) return absl::UnavailableError("the stream has ended");
  outgoing_.push_back(request);
  if (outgoing_.size() == 1) StartWrite(&outgoing_.front());
  return absl::OkStatus();
}

std::optional<absl::StatusOr<StreamCall::Incoming>> StreamCall::Receive(absl::Duration deadline) {
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

void StreamCall::CloseSend() {
  absl::MutexLock lock(&mutex_);
  if (send_closed_ || read_ended_) return;
  send_closed_ = true;
  if (outgoing_.empty()) StartWritesDone();
}

void StreamCall::OnReadDone(bool ok) {
  absl::MutexLock lock(&mutex_);
  if (!ok) {
    read_ended_ = true;
    RemoveHold();
    return;
  }
  responses_.push_back({std::move(incoming_), std::chrono::steady_clock::now()});
  incoming_.Clear();
  changed_.notify_one();
  StartRead(&incoming_);
}

void StreamCall::OnWriteDone(bool ok) {
  absl::MutexLock lock(&mutex_);
  if (!ok || read_ended_) return;  // the call is over; OnDone has the status
  outgoing_.pop_front();
  if (!outgoing_.empty()) {
    StartWrite(&outgoing_.front());
  } else if (send_closed_) {
    StartWritesDone();
  }
}

void StreamCall::OnDone(const grpc::Status& status) {
  absl::MutexLock lock(&mutex_);
  final_status_ = StatusFromGrpc(status);
  changed_.notify_all();
}

}  // namespace spikeserve
