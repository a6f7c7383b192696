// One attempt of a unary call, which does not block.
//
// Not thread-safe.
#ifndef CLIENT_SRC_PILOT_SERVER_CALL_H_
#define CLIENT_SRC_PILOT_SERVER_CALL_H_

#include <grpcpp/client_context.h>

#include <functional>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "client/src/connection.h"
#include "client/src/replicas.h"

namespace spikeserve::piloting {

class ServerCall {
 public:
  // Prepares a call at the preferred server of `route`, which may take `timeout`. `on_done` is
  // called once, on a thread of gRPC. The arguments must outlive the call.
  ServerCall(Replicas* replicas, Route* route, absl::Duration timeout,
             std::function<void()> on_done);
  // Cancels a call that is under way, and blocks until on_done has returned.
  ~ServerCall();

  // Begin the call. Exactly one of them, once.
  void Begin(const v1::OpenSessionRequest& request);
  void Begin(const v1::ExportSessionRequest& request);
  void Begin(const v1::EndEpisodeRequest& request);
  void Begin(const v1::CloseSessionRequest& request);

  // Waits for the end of the call. Returns its status, and tells the replicas about it.
  absl::Status Await() ABSL_LOCKS_EXCLUDED(mutex_);

  const Replica* replica() const { return replica_; }

  // The response, after the call has ended with OK.
  const v1::OpenSessionResponse& opened() const { return opened_; }
  const v1::ExportSessionResponse& exported() const { return exported_; }
  const v1::EndEpisodeResponse& ended() const { return ended_; }

 private:
  std::function<void(grpc::Status)> Done();

  Replicas* const replicas_;
  Route* const route_;
  const absl::Duration timeout_;
  const std::function<void()> on_done_;
  Replica* const replica_;
  grpc::ClientContext context_;
  Connection::Watched watched_;
  v1::OpenSessionRequest open_;
  v1::ExportSessionRequest export_;
  v1::EndEpisodeRequest end_;
  v1::CloseSessionRequest close_;
  v1::OpenSessionResponse opened_;
  v1::ExportSessionResponse exported_;
  v1::EndEpisodeResponse ended_;
  v1::CloseSessionResponse closed_;
  absl::Mutex mutex_;
  grpc::Status status_ ABSL_GUARDED_BY(mutex_);
  bool is_under_way_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_SERVER_CALL_H_
