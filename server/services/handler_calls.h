// Calls that a method of a handler answers. A call for a session that this server does not hold is
// answered after the session was taken over from the store, and an answer that a session's
// durability delays is sent when the store has what the answer tells.
//
// Confined to the thread of the call's loop, except that BackgroundCall runs its method on a
// worker.
#ifndef SERVER_SERVICES_HANDLER_CALLS_H_
#define SERVER_SERVICES_HANDLER_CALLS_H_

#include <atomic>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>

#include "absl/status/status.h"
#include "server/access/authenticator.h"
#include "server/agent/deferred_work.h"
#include "server/agent/durable_answer.h"
#include "server/base/background_worker.h"
#include "server/base/peer.h"
#include "server/services/unary_call.h"
#include "server/transport/grpc_wire.h"

namespace spikeserve {

// Calls `handler.*method` with the arguments that its form takes.
template <typename Handler, typename Method, typename Request, typename Response>
absl::Status Invoke(Handler& handler, Method method, const Credential& caller,
                    const Request& request, Response* response, DeferredWork* deferred,
                    Commits* commits, bool may_claim) {
  if constexpr (std::is_invocable_v<Method, Handler&, const Request&, Response*>) {
    return (handler.*method)(request, response);
  } else if constexpr (std::is_invocable_v<Method, Handler&, const Credential&, const Request&,
                                           Response*>) {
    return (handler.*method)(caller, request, response);
  } else if constexpr (std::is_invocable_v<Method, Handler&, const Credential&, const Request&,
                                           Response*, Commits*>) {
    return (handler.*method)(caller, request, response, commits);
  } else if constexpr (std::is_invocable_v<Method, Handler&, const Credential&, const Request&,
                                           Response*, Commits*, bool>) {
    return (handler.*method)(caller, request, response, commits, may_claim);
  } else if constexpr (std::is_invocable_v<Method, Handler&, const Credential&, const Request&,
                                           Response*, DeferredWork*>) {
    return (handler.*method)(caller, request, response, deferred);
  } else {
    return (handler.*method)(caller, request, response, deferred, commits);
  }
}

// Runs `Answer(caller, request, response, deferred, commits, may_claim)`, which returns a
// CallOutcome, on the loop. For methods that are quick. `deferred` is work that the loop does after
// it has sent the answer.
template <typename Request, typename Response, typename Answer>
class InlineCall final : public UnaryCall<Request, Response> {
 public:
  InlineCall(const ServiceContext* context, Call* call, Method method, DeferredWork* deferred,
             const Answer* answer)
      : UnaryCall<Request, Response>(context, call, method),
        deferred_(deferred),
        answer_(*answer) {}

 private:
  void Handle() override {
    this->EndWhenDurable(answer_(this->caller(), this->request(), this->response(), deferred_,
                                 this->commits(), this->may_claim()));
  }

  DeferredWork* const deferred_;
  const Answer& answer_;
};

// Runs `Answer` on a background worker. For methods that take long. The tenants of the callers take
// turns. A call that is over before its turn comes is not computed. An `Answer` that is recorded
// takes (caller, peer, request, response).
template <typename Request, typename Response, typename Answer>
class BackgroundCall final : public UnaryCall<Request, Response> {
 public:
  BackgroundCall(const ServiceContext* context, Call* call, Method method, BackgroundWorker* worker,
                 const Answer* answer)
      : UnaryCall<Request, Response>(context, call, method), worker_(*worker), answer_(*answer) {}

  void OnClosed() override {
    over_ = true;
    UnaryCall<Request, Response>::OnClosed();
  }

 private:
  void Handle() override {
    auto self = std::static_pointer_cast<BackgroundCall>(this->shared_from_this());
    if constexpr (kTakesPeer) peer_ = this->call()->peer();
    const absl::Status status = worker_.Submit(
        this->caller().tenant()->name(),
        [self = std::move(self), loop = &this->call()->loop()]() mutable {
          if (self->over_) {
            // Destroyed on the loop's thread, like every call.
            return loop->Post([self = std::move(self)] {});
          }
          CallOutcome outcome = self->Compute();
          self->CheckResponse(&outcome);
          self->Frame(outcome);
          loop->Post([self = std::move(self), outcome] { self->EndWhenDurable(outcome); });
        });
    // A caller that asks again at once is delayed, as after any other refusal.
    if (!status.ok()) this->End({status, absl::ResourceExhaustedError(status.message())});
  }

  // Leaves nothing to the loop that takes longer for a longer response, not even to free it.
  void Frame(const CallOutcome& outcome) {
    framed_.clear();
    if (!outcome.status.ok()) return;
    AppendMessage(*this->response(), &framed_);
    if (this->commits()->empty()) this->messages().Free();
  }

  int64_t framed_bytes() const override { return static_cast<int64_t>(framed_.capacity()); }

  void SendResponse() override { this->call()->SendFramed(std::move(framed_)); }

  static constexpr bool kTakesPeer =
      std::is_invocable_v<Answer, const Credential&, const Peer&, const Request&, Response*>;

  CallOutcome Compute() {
    if constexpr (kTakesPeer) {
      return answer_(this->caller(), peer_, this->request(), this->response());
    } else {
      return answer_(this->caller(), this->request(), this->response(), nullptr, this->commits(),
                     this->may_claim());
    }
  }

  BackgroundWorker& worker_;
  const Answer& answer_;
  Peer peer_;           // set before the worker reads it
  std::string framed_;  // the response; the worker serializes it, because it may be long
  std::atomic<bool> over_ = false;
};

}  // namespace spikeserve

#endif  // SERVER_SERVICES_HANDLER_CALLS_H_
