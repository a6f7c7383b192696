// One ActStream call: read a request, answer it, and so on, until the client or the server has had
// enough.
#ifndef SERVER_ACT_STREAM_H_
#define SERVER_ACT_STREAM_H_

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <memory>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "core/session/clock.h"
#include "server/authenticator.h"
#include "server/call_tracker.h"
#include "server/metrics.h"
#include "server/request_handler.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What every call needs; all must outlive the call.
struct ServiceParts {
  const RequestHandler* handler;
  CallTracker* calls;
  const Authenticator* authenticator;
  Metrics* metrics;
  const Clock* clock;
};

// Keeps itself alive from Start() until gRPC is done with it. One operation is under way at a time,
// so the messages need no lock; Drain() may come from any thread in between.
class ActStream final : public grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>,
                        public CallTracker::Stream {
 public:
  // A stream that reads its first request, or is refused where the server drains or the caller may
  // not make it. A token that expires later fails the requests that come then.
  static ActStream* Start(const ServiceParts& parts, const grpc::CallbackServerContext& context);

  void OnReadDone(bool ok) override;
  void OnWriteDone(bool ok) override;
  void OnDone() override;

  // Ends the call with UNAVAILABLE, after the reply that is under way, if one is.
  void Drain() override;

 private:
  enum class State { kReading, kReplying, kFinished };

  ActStream(const ServiceParts& parts, absl::StatusOr<const Credential*> caller)
      : parts_(parts), caller_(std::move(caller)) {}

  absl::Status Handle(DeferredWork* deferred);
  void Answer(DeferredWork* deferred);
  void FinishLocked(const absl::Status& status) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const ServiceParts parts_;
  const absl::StatusOr<const Credential*> caller_;
  std::shared_ptr<ActStream> self_;
  v1::ActRequest request_;
  v1::ActResponse response_;

  absl::Mutex mutex_;  // held for a change of state only, never for a decision
  State state_ ABSL_GUARDED_BY(mutex_) = State::kReading;
  bool draining_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace spikeserve

#endif  // SERVER_ACT_STREAM_H_
