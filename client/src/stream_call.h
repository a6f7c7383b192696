// One call of ActStream.
//
// Thread-safe.
#pragma once

#include <grpcpp/client_context.h>
#include <grpcpp/support/client_callback.h>

#include <chrono>
#include <condition_variable>
#include <deque>
#include <optional>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "client/src/connection.h"
#include "client/src/replicas.h"

namespace spikeserve {

// gRPC allows one read and one write at a time. A read is always active; requests wait in a queue
// whose front is being written.
class StreamCall : public grpc::ClientBidiReactor<v1::ActRequest, v1::ActResponse> {
 public:
  struct Incoming {
    v1::ActResponse response;
    std::chrono::steady_clock::time_point arrived;
  };

  // A fresh line of `connection`, which must outlive the call, cancels the call.
  StreamCall(RenewableConnection* connection, const Route& route);
  // Cancels the call if it has not ended, and blocks until gRPC has called OnDone.
  ~StreamCall() override;

  // Queues one request. Returns the status of the call if it has ended.
  absl::Status Send(const v1::ActRequest& request) ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns the next response, or nothing if none arrives until `deadline` of SteadyNow(). After
  // the call has ended and all responses were returned: its status, or OUT_OF_RANGE if that is OK.
  std::optional<absl::StatusOr<Incoming>> Receive(absl::Duration deadline)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Declares that no more requests follow.
  void CloseSend() ABSL_LOCKS_EXCLUDED(mutex_);

  void OnReadDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_);
  void OnWriteDone(bool ok) override ABSL_LOCKS_EXCLUDED(mutex_);
  void OnDone(const grpc::Status& status) override ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  grpc::ClientContext context_;
  RenewableConnection::Watched watched_;
  v1::ActResponse incoming_;  // written by gRPC between StartRead and OnReadDone

  absl::Mutex mutex_;
  // Notified when a response arrives or the call ends. A CondVar of Abseil would measure its
  // timeouts by the time of day.
  std::condition_variable_any changed_;
  std::deque<v1::ActRequest> outgoing_ ABSL_GUARDED_BY(mutex_);  // the front is being written
  std::deque<Incoming> responses_ ABSL_GUARDED_BY(mutex_);
  bool send_closed_ ABSL_GUARDED_BY(mutex_) = false;
  bool read_ended_ ABSL_GUARDED_BY(mutex_) = false;  // no more responses will arrive
  std::optional<absl::Status> final_status_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
