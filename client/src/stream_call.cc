#include "client/src/stream_call.h"

#include <utility>

#include "spikeserve/status.h"

namespace spikeserve {

StreamCall::StreamCall(v1::PolicyService::Stub& stub, const Route& route) {
  context_.AddMetadata(kAffinityKey, route.key);
  stub.async()->ActStream(&context_, this);
  // Writes start outside of gRPC's callbacks. The hold keeps gRPC from ending the call before them.
  AddHold();
  StartRead(&incoming_);
  StartCall();
}

StreamCall::~StreamCall() {
  context_.TryCancel();
  absl::MutexLock lock(&mutex_);
  while (!final_status_.has_value()) changed_.Wait(&mutex_);
}

absl::Status StreamCall::Send(const v1::ActRequest& request) {
  absl::MutexLock lock(&mutex_);
  if (final_status_.has_value() && !final_status_->ok()) return *final_status_;
  if (read_ended_) return absl::UnavailableError("the stream has ended");
  outgoing_.push_back(request);
  if (outgoing_.size() == 1) StartWrite(&outgoing_.front());
  return absl::OkStatus();
}

std::optional<absl::StatusOr<StreamCall::Incoming>> StreamCall::Receive(absl::Time deadline) {
  absl::MutexLock lock(&mutex_);
  while (responses_.empty() && !final_status_.has_value()) {
    if (changed_.WaitWithDeadline(&mutex_, deadline) && responses_.empty() &&
        !final_status_.has_value()) {
      return std::nullopt;
    }
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
  changed_.Signal();
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
  changed_.SignalAll();
}

}  // namespace spikeserve
