// One call of ActStream, whose replies are passed on as they arrive.
//
// Thread-safe.
#pragma once

#include <grpcpp/client_context.h>
#include <grpcpp/support/client_callback.h>

#include <deque>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "client/src/connection.h"
#include "client/src/replicas.h"

namespace spikeserve::piloting {

class ActionStream : public grpc::ClientBidiReactor<v1::ActRequest, v1::ActResponse> {
 public:
  // Called on threads of gRPC, one call at a time, and must not block.
  class Listener {
   public:
    virtual ~Listener() = default;
    virtual void OnReply(const v1::ActResponse& reply) = 0;
    // The call is over. Nothing follows.
    virtual void OnEnd(const absl::Status& status) = 0;
  };

  // Opens the call. A fresh line of `connection` cancels it. The arguments must outlive the stream.
  ActionStream(RenewableConnection* connection, const Route& route, Listener* listener);
  // Cancels the call if it has not ended, and blocks until the last call of the listener.
  ~ActionStream() override;

  // Sends a request without waiting.
  void Send(v1::ActRequest request) ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns whether a fresh line has replaced that of the call.
  bool IsRenewed() const { return watched_.line().channel != connection_->line()->channel; }

  void OnReadDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_);
  void OnWriteDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_);
  void OnDone(const grpc::Status& status) override ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  RenewableConnection* const connection_;
  Listener* const listener_;
  grpc::ClientContext context_;
  RenewableConnection::Watched watched_;
  v1::ActResponse incoming_;  // written by gRPC between StartRead and OnReadDone

  absl::Mutex mutex_;
  std::deque<v1::ActRequest> outgoing_ ABSL_GUARDED_BY(mutex_);  // the front is being written
  bool has_ended_ ABSL_GUARDED_BY(mutex_) = false;               // no more writes may begin
  bool is_done_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace spikeserve::piloting
