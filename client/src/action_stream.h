// One call of ActStream, whose replies are passed on as they arrive.
//
// Thread-safe.
#pragma once

#include <grpcpp/client_context.h>
#include <grpcpp/support/client_callback.h>

#include <deque>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "client/src/connection.h"
#include "client/src/replicas.h"
#include "spikeserve/status.h"

namespace spikeserve {

class ActionStream : public grpc::ClientBidiReactor<v1::ActRequest, v1::ActResponse> {
 public:
  // Called on threads of gRPC, one call at a time, and must not block.
  class Listener {
   public:
    virtual ~Listener() = default;
    virtual void OnReply(v1::ActResponse&& reply) = 0;
    // The call is over. Nothing follows.
    virtual void OnEnd(const absl::Status& status) = 0;
  };

  // Opens the call. A fresh line of `connection` cancels it. The arguments must outlive the stream.
  ActionStream(RenewableConnection* connection, const Route& route, Listener* listener)
      : connection_(connection),
        listener_(listener),
        watched_(connection, &context_, /*expects_answer=*/false) {
    context_.AddMetadata(kAffinityKey, route.key);
    watched_.line().stub->async()->ActStream(&context_, this);
    // Writes start outside of gRPC's callbacks. The hold keeps gRPC from ending the call before
    // them.
    AddHold();
    StartRead(&incoming_);
    StartCall();
  }

  // Cancels the call if it has not ended, and blocks until the last call of the listener.
  ~ActionStream() override {
    context_.TryCancel();
    absl::MutexLock lock(&mutex_);
    mutex_.Await(absl::Condition(&is_done_));
  }

  // Sends a request without waiting. Returns false if no more replies will arrive.
  bool Send(v1::ActRequest request) ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (has_ended_) return false;
    outgoing_.push_back(std::move(request));
    if (outgoing_.size() == 1) StartWrite(&outgoing_.front());
    return true;
  }

  // Declares that no more requests follow.
  void CloseSend() ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (send_closed_ || has_ended_) return;
    send_closed_ = true;
    if (outgoing_.empty()) StartWritesDone();
  }

  // Returns whether a fresh line has replaced that of the call.
  bool IsRenewed() const { return watched_.line().channel != connection_->line()->channel; }

  void OnReadDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_) {
    if (ok) {
      listener_->OnReply(std::move(incoming_));
      incoming_.Clear();
      StartRead(&incoming_);
      return;
    }
    absl::MutexLock lock(&mutex_);
    has_ended_ = true;
    RemoveHold();
  }

  void OnWriteDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (!ok || has_ended_) return;  // OnDone follows
    outgoing_.pop_front();
    if (!outgoing_.empty()) {
      StartWrite(&outgoing_.front());
    } else if (send_closed_) {
      StartWritesDone();
    }
  }

  void OnDone(const grpc::Status& status) override ABSL_LOCKS_EXCLUDED(mutex_) {
    listener_->OnEnd(StatusFromGrpc(status));
    absl::MutexLock lock(&mutex_);
    is_done_ = true;
  }

 private:
  RenewableConnection* const connection_;
  Listener* const listener_;
  grpc::ClientContext context_;
  RenewableConnection::Watched watched_;
  v1::ActResponse incoming_;  // written by gRPC between StartRead and OnReadDone

  absl::Mutex mutex_;
  std::deque<v1::ActRequest> outgoing_ ABSL_GUARDED_BY(mutex_);  // the front is being written
  bool send_closed_ ABSL_GUARDED_BY(mutex_) = false;
  bool has_ended_ ABSL_GUARDED_BY(mutex_) = false;  // no more writes may begin
  bool is_done_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace spikeserve
