// One attempt of a unary call, which does not block.
//
// Not thread-safe.
#pragma once

#include <grpcpp/client_context.h>

#include <functional>
#include <memory>

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

  using Async = v1::PolicyService::StubInterface::async_interface;

  // Begins a call of `method`. Once.
  template <typename Request, typename Response>
  void Begin(void (Async::*method)(grpc::ClientContext*, const Request*, Response*,
                                   std::function<void(grpc::Status)>),
             const Request& request) {
    const auto sent = std::make_shared<Request>(request);
    const auto received = std::make_shared<Response>();
    request_ = sent;
    response_ = received;
    (watched_.line().stub->async()->*method)(&context_, sent.get(), received.get(), Done());
  }

  // Waits for the end of the call. Returns its status, and tells the replicas about it.
  absl::Status Await() ABSL_LOCKS_EXCLUDED(mutex_);

  const Replica* replica() const { return replica_; }

  // Returns the response, after the call has ended with OK. REQUIRES: it is of this type.
  template <typename Response>
  const Response& response() const {
    return *static_cast<const Response*>(response_.get());
  }

 private:
  std::function<void(grpc::Status)> Done();

  Replicas* const replicas_;
  Route* const route_;
  const absl::Duration timeout_;
  const std::function<void()> on_done_;
  Replica* const replica_;
  grpc::ClientContext context_;
  RenewableConnection::Watched watched_;
  std::shared_ptr<void> request_;
  std::shared_ptr<void> response_;
  absl::Mutex mutex_;
  grpc::Status status_ ABSL_GUARDED_BY(mutex_);
  bool is_under_way_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace spikeserve::piloting
