#include "spikeserve/remote_stream.h"

#include <grpcpp/client_context.h>
#include <grpcpp/support/client_callback.h>

#include <deque>
#include <optional>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/clock.h"
#include "spikeserve/status.h"

namespace spikeserve {

// gRPC allows one read and one write at a time. A read is always active; requests wait in a queue
// whose front is being written.
class RemoteStream::Call : public grpc::ClientBidiReactor<v1::ActRequest, v1::ActResponse> {
 public:
  explicit Call(v1::PolicyService::Stub& stub) {
    stub.async()->ActStream(&context_, this);
    // Writes start outside of gRPC's callbacks. The hold keeps gRPC from ending the call before
    // them.
    AddHold();
    StartRead(&incoming_);
    StartCall();
  }

  absl::Status Send(const v1::ActRequest& request) ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (final_status_.has_value() && !final_status_->ok()) return *final_status_;
    if (read_ended_) return absl::UnavailableError("the stream has ended");
    if (send_closed_) return absl::FailedPreconditionError("the stream is closed for sending");
    outgoing_.push_back(request);
    if (outgoing_.size() == 1) StartWrite(&outgoing_.front());
    return absl::OkStatus();
  }

  absl::StatusOr<ActReply> Receive(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    const absl::Time deadline = absl::Now() + timeout;
    while (replies_.empty() && !final_status_.has_value()) {
      if (changed_.WaitWithDeadline(&mutex_, deadline) && replies_.empty() &&
          !final_status_.has_value()) {
        return absl::DeadlineExceededError("no reply within " + absl::FormatDuration(timeout));
      }
    }
    if (replies_.empty()) {
      return final_status_->ok() ? absl::OutOfRangeError("the stream has ended") : *final_status_;
    }
    ActReply reply = std::move(replies_.front());
    replies_.pop_front();
    return reply;
  }

  void CloseSend() ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (send_closed_ || read_ended_) return;
    send_closed_ = true;
    if (outgoing_.empty()) StartWritesDone();
  }

  // Cancels the call if it has not ended, and blocks until gRPC has called OnDone.
  void Shutdown() ABSL_LOCKS_EXCLUDED(mutex_) {
    context_.TryCancel();
    absl::MutexLock lock(&mutex_);
    while (!final_status_.has_value()) changed_.Wait(&mutex_);
  }

  void OnReadDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (!ok) {
      read_ended_ = true;
      RemoveHold();
      return;
    }
    replies_.push_back(TakeIncoming());
    changed_.Signal();
    StartRead(&incoming_);
  }

  void OnWriteDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (!ok || read_ended_) return;  // the call is over; OnDone has the status
    outgoing_.pop_front();
    if (!outgoing_.empty()) {
      StartWrite(&outgoing_.front());
    } else if (send_closed_) {
      StartWritesDone();
    }
  }

  void OnDone(const grpc::Status& status) override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    final_status_ = StatusFromGrpc(status);
    changed_.SignalAll();
  }

 private:
  ActReply TakeIncoming() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    ActReply reply{.session_id = incoming_.session_id(),
                   .step = incoming_.step(),
                   .response = v1::ActResponse(),
                   .arrived = std::chrono::steady_clock::now()};
    if (incoming_.has_error()) {
      const v1::ActError& error = incoming_.error();
      std::optional<double> delay;
      if (error.has_retry_after_seconds()) delay = error.retry_after_seconds();
      reply.response = ForSession(StatusFromCode(error.code(), error.message(), delay));
    } else {
      reply.response = std::move(incoming_);
    }
    incoming_.Clear();
    return reply;
  }

  grpc::ClientContext context_;
  v1::ActResponse incoming_;  // written by gRPC between StartRead and OnReadDone

  absl::Mutex mutex_;
  absl::CondVar changed_;  // signalled when a reply arrives or the call ends
  std::deque<v1::ActRequest> outgoing_ ABSL_GUARDED_BY(mutex_);  // the front is being written
  std::deque<ActReply> replies_ ABSL_GUARDED_BY(mutex_);
  bool send_closed_ ABSL_GUARDED_BY(mutex_) = false;
  bool read_ended_ ABSL_GUARDED_BY(mutex_) = false;  // no more replies will arrive
  std::optional<absl::Status> final_status_ ABSL_GUARDED_BY(mutex_);
};

RemoteStream::RemoteStream(v1::PolicyService::Stub& stub) : call_(std::make_unique<Call>(stub)) {}

RemoteStream::~RemoteStream() { call_->Shutdown(); }

absl::Status RemoteStream::Send(const v1::ActRequest& request) { return call_->Send(request); }

absl::StatusOr<ActReply> RemoteStream::Receive(absl::Duration timeout) {
  return call_->Receive(timeout);
}

void RemoteStream::CloseSend() { call_->CloseSend(); }

}  // namespace spikeserve
