// Calls that a method of a handler answers.
//
// Confined to the thread of the call's loop, except that BackgroundCall runs its method on a
// worker.
#pragma once

#include <google/protobuf/message.h>

#include <atomic>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "server/agent/call_context.h"
#include "server/base/background_worker.h"
#include "server/services/unary_call.h"
#include "server/transport/grpc_wire.h"

namespace spikeserve {

// Answers the requests of one method; see call_context.h.
struct Handler {
  using Message = google::protobuf::Message;

  template <typename H, typename Request, typename Response>
  Handler(const H* handler,
          absl::Status (H::*method)(CallContext&, const Request&, Response*) const)
      : request_type(Request::default_instance()),
        response_type(Response::default_instance()),
        answer([handler, method](CallContext& context, const Message& request, Message* response) {
          return (handler->*method)(context, static_cast<const Request&>(request),
                                    static_cast<Response*>(response));
        }) {}

  const Message& request_type;  // the default instances of the types
  const Message& response_type;
  std::function<absl::Status(CallContext&, const Message&, Message*)> answer;
};

// Answers on the loop. For methods that are quick.
class InlineCall final : public UnaryCall {
 public:
  // `deferred` is work that the loop does after it has sent the answer. All must outlive the call.
  InlineCall(const ServiceContext* context, Call* call, const Method& method,
             DeferredWork* deferred, const Handler* handler)
      : UnaryCall(context, call, method, handler->request_type, handler->response_type),
        handler_(*handler) {
    call_context().deferred = deferred;
  }

 private:
  void Handle() override { Leave(handler_.answer(call_context(), request(), response())); }

  const Handler& handler_;
};

// Answers on a background worker. For methods that take long. The tenants of the callers take
// turns. A call that is over before its turn comes is not computed.
class BackgroundCall final : public UnaryCall {
 public:
  // All must outlive the call. If `is_recorded`, the handler learns who the peer is.
  BackgroundCall(const ServiceContext* context, Call* call, const Method& method,
                 BackgroundWorker* worker, const Handler* handler, bool is_recorded)
      : UnaryCall(context, call, method, handler->request_type, handler->response_type),
        worker_(*worker),
        handler_(*handler),
        is_recorded_(is_recorded) {}

  void OnClosed() override {
    over_ = true;
    UnaryCall::OnClosed();
  }

 private:
  void Handle() override {
    auto self = std::static_pointer_cast<BackgroundCall>(shared_from_this());
    if (is_recorded_) call_context().peer = call()->peer();
    const absl::Status status = worker_.Submit(
        caller().tenant()->name(), [self = std::move(self), loop = &loop()]() mutable {
          if (self->over_) {
            // Destroyed on the loop's thread, like every call.
            return loop->Post([self = std::move(self)] {});
          }
          CallOutcome outcome =
              self->handler_.answer(self->call_context(), self->request(), self->response());
          self->CheckResponse(&outcome);
          self->Frame(outcome.status);
          loop->Post([self = std::move(self), status = outcome.status] { self->Leave(status); });
        });
    // A caller that asks again at once is delayed, as after any other refusal.
    if (!status.ok()) End({status, absl::ResourceExhaustedError(status.message())});
  }

  // Leaves nothing to the loop that takes longer for a longer response, not even to free it.
  void Frame(const absl::Status& status) {
    framed_.clear();
    if (!status.ok()) return;
    AppendMessage(*response(), &framed_);
    if (call_context().commits.empty()) messages().Free();
  }

  void TakeMerged(const FleetContribution& contribution) override {
    UnaryCall::TakeMerged(contribution);
    Frame(absl::OkStatus());
  }

  int64_t framed_bytes() const override { return static_cast<int64_t>(framed_.capacity()); }

  void SendResponse() override { call()->SendFramed(std::move(framed_)); }

  BackgroundWorker& worker_;
  const Handler& handler_;
  const bool is_recorded_;
  std::string framed_;  // the response; the worker serializes it, because it may be long
  std::atomic<bool> over_ = false;
};

}  // namespace spikeserve
