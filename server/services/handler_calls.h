// Calls that a method of a handler answers.
//
// Confined to the thread of the call's loop, except that BackgroundCall runs its method on a
// worker.
#pragma once

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

// Answers a request; see call_context.h.
template <typename Request, typename Response>
using Handler = std::function<absl::Status(CallContext&, const Request&, Response*)>;

// Answers on the loop. For methods that are quick.
template <typename Request, typename Response>
class InlineCall final : public UnaryCall<Request, Response> {
 public:
  // `deferred` is work that the loop does after it has sent the answer. All must outlive the call.
  InlineCall(const ServiceContext* context, Call* call, const Method& method,
             DeferredWork* deferred, const Handler<Request, Response>* handler)
      : UnaryCall<Request, Response>(context, call, method), handler_(*handler) {
    this->call_context().deferred = deferred;
  }

 private:
  void Handle() override {
    this->Leave(handler_(this->call_context(), this->request(), this->response()));
  }

  const Handler<Request, Response>& handler_;
};

// Answers on a background worker. For methods that take long. The tenants of the callers take
// turns. A call that is over before its turn comes is not computed.
template <typename Request, typename Response>
class BackgroundCall final : public UnaryCall<Request, Response> {
 public:
  // All must outlive the call. If `is_recorded`, the handler learns who the peer is.
  BackgroundCall(const ServiceContext* context, Call* call, const Method& method,
                 BackgroundWorker* worker, const Handler<Request, Response>* handler,
                 bool is_recorded)
      : UnaryCall<Request, Response>(context, call, method),
        worker_(*worker),
        handler_(*handler),
        is_recorded_(is_recorded) {}

  void OnClosed() override {
    over_ = true;
    UnaryCall<Request, Response>::OnClosed();
  }

 private:
  void Handle() override {
    auto self = std::static_pointer_cast<BackgroundCall>(this->shared_from_this());
    if (is_recorded_) this->call_context().peer = this->call()->peer();
    const absl::Status status = worker_.Submit(
        this->caller().tenant()->name(), [self = std::move(self), loop = &this->loop()]() mutable {
          if (self->over_) {
            // Destroyed on the loop's thread, like every call.
            return loop->Post([self = std::move(self)] {});
          }
          CallOutcome outcome =
              self->handler_(self->call_context(), self->request(), self->response());
          self->CheckResponse(&outcome);
          self->Frame(outcome.status);
          loop->Post([self = std::move(self), status = outcome.status] { self->Leave(status); });
        });
    // A caller that asks again at once is delayed, as after any other refusal.
    if (!status.ok()) this->End({status, absl::ResourceExhaustedError(status.message())});
  }

  // Leaves nothing to the loop that takes longer for a longer response, not even to free it.
  void Frame(const absl::Status& status) {
    framed_.clear();
    if (!status.ok()) return;
    AppendMessage(*this->response(), &framed_);
    if (this->call_context().commits.empty()) this->messages().Free();
  }

  void TakeMerged(const FleetContribution& contribution) override {
    UnaryCall<Request, Response>::TakeMerged(contribution);
    Frame(absl::OkStatus());
  }

  int64_t framed_bytes() const override { return static_cast<int64_t>(framed_.capacity()); }

  void SendResponse() override { this->call()->SendFramed(std::move(framed_)); }

  BackgroundWorker& worker_;
  const Handler<Request, Response>& handler_;
  const bool is_recorded_;
  std::string framed_;  // the response; the worker serializes it, because it may be long
  std::atomic<bool> over_ = false;
};

}  // namespace spikeserve
