// What every call of our services does: admits the caller, measures, delays refusals, and ends when
// the server stops.
//
// Confined to the thread of the call's loop.
#pragma once

#include <cstddef>
#include <functional>
#include <memory>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/access/authenticator.h"
#include "server/agent/session_recovery.h"
#include "server/base/method.h"
#include "server/services/request_span.h"
#include "server/services/service_context.h"
#include "server/trace/span.h"
#include "server/transport/call.h"

namespace spikeserve {

class ServiceCall : public CallHandler, public std::enable_shared_from_this<ServiceCall> {
 public:
  // `context` must outlive the call.
  ServiceCall(const ServiceContext* context, Call* call, const Method& method)
      : context_(*context),
        call_(call),
        loop_(call->loop()),
        method_(method),
        admission_(context->gate->Begin()) {}
  ~ServiceCall() override { context_.gate->End(); }

  // Admits the caller, or refuses the call. To be called once, right after construction.
  void Start();

  size_t message_limit() const override { return static_cast<size_t>(context_.max_message_bytes); }
  void OnMessage(absl::string_view message) final;
  void OnTooLong(size_t length) final;
  void OnHalfClose() final;
  void OnClosed() override;
  void OnDrain() override;

 protected:
  // The caller was admitted and sent a message of at most message_limit() bytes.
  virtual void HandleMessage(absl::string_view message) = 0;
  // As above, but the message was too long; `error` is its refusal.
  virtual void HandleTooLong(size_t length, const absl::Status& error) = 0;

  // The caller was admitted and will send no more messages.
  virtual void HandleHalfClose() = 0;

  const ServiceContext& context() const { return context_; }
  const Method& method() const { return method_; }
  // Null after the call is over.
  Call* call() const { return call_; }
  // Outlives the call.
  EventLoop& loop() const { return loop_; }
  // REQUIRES: the caller was admitted, which holds in HandleMessage() and after it.
  const Credential& caller() const { return **caller_; }

  // Counts a request that started at `start` and ended with `status`; `policy` as for ObserveRpc.
  void Observe(const absl::Status& status, absl::Duration start, absl::string_view policy = "") {
    context_.metrics->ObserveRpc(method_, status.code(), context_.clock->Now() - start, policy);
  }

  // Begins the span of a request that has arrived; empty if it is not traced. REQUIRES: the call is
  // not over.
  Span StartSpan(const TraceParent& parent) const {
    return context_.tracer == nullptr
               ? Span()
               : StartRequestSpan(*context_.tracer, call_->head().path, parent);
  }
  // Ends the span of a request that is answered with `status`.
  void EndSpan(const absl::Status& status, Span* span) const {
    if (*span) FinishRequestSpan(caller(), status, span);
  }

  // Runs `next` now, or, if `status` is a refusal, after the delay that refused callers get.
  // REQUIRES: the call is not over, and no delay is running.
  void AfterDelay(const absl::Status& status, size_t request_bytes, std::function<void()> next);
  // Reads no further messages for the delay that refused callers get, if `status` is a refusal.
  // REQUIRES: the call is not over.
  void PauseAfter(const absl::Status& status, size_t request_bytes);

  // Returns true while a delay of AfterDelay() or PauseAfter() is running.
  bool is_delayed() const { return delayed_ != nullptr; }

  // Ends the call. Does nothing if it is over.
  void Finish(const absl::Status& status);

 private:
  const ServiceContext& context_;
  Call* call_;
  EventLoop& loop_;
  const Method& method_;
  absl::Duration DelayFor(const absl::Status& status, size_t request_bytes) const;

  absl::Status admission_;
  absl::StatusOr<std::shared_ptr<const Credential>> caller_ = absl::UnauthenticatedError("");
  std::function<void()> delayed_;  // runs when `timer_` fires, or when the server drains
  EventLoop::Timer timer_;
};

}  // namespace spikeserve
