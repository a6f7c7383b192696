#include "server/unary_call.h"

#include <grpcpp/alarm.h>

#include <chrono>
#include <utility>

#include "absl/time/time.h"
#include "server/admission.h"
#include "server/status_map.h"

namespace spikeserve {
namespace {

// Keeps a unary call on the books until gRPC has sent its answer. gRPC sends once the method has
// returned, so what may wait is done in OnDone.
class UnaryCall final : public grpc::ServerUnaryReactor {
 public:
  UnaryCall(CallTracker* calls, const google::protobuf::MessageLite& request)
      : calls_(calls), request_(request), accepted_(calls->Begin()) {}

  bool accepted() const { return accepted_; }
  DeferredWork* deferred() { return &deferred_; }

  // A refused caller waits for its answer, so that it cannot ask at once again.
  void FinishAfterRest(const absl::Status& status) {
    if (status.ok()) return Finish(grpc::Status::OK);
    const absl::Duration rest = RefusalRest(status, request_.ByteSizeLong());
    if (rest == absl::ZeroDuration()) return Finish(ToGrpcStatus(status));
    alarm_.Set(std::chrono::system_clock::now() + absl::ToChronoNanoseconds(rest),
               [this, status](bool /*ok*/) { Finish(ToGrpcStatus(status)); });
  }

  void OnDone() override {
    deferred_.Run();
    calls_->End();
    delete this;  // gRPC's reactors own themselves
  }

  // Otherwise gRPC wakes another thread for OnDone. It means this for its own reactions, which
  // never wait; ours may wait for a decision of the same session, for as long as that takes.
  bool InternalInlineable() override { return true; }

 private:
  CallTracker* const calls_;
  const google::protobuf::MessageLite& request_;  // gRPC keeps it until OnDone
  const bool accepted_;
  DeferredWork deferred_;
  grpc::Alarm alarm_;
};

void FinishCall(const ServiceParts& parts, Method method, absl::Duration start,
                const absl::Status& status, UnaryCall* call) {
  parts.metrics->ObserveRpc(method, status.code(), parts.clock->Now() - start);
  call->FinishAfterRest(status);
}

using Handle = absl::FunctionRef<absl::Status(const Credential& caller, DeferredWork*)>;

absl::Status AdmitAndHandle(const ServiceParts& parts, const grpc::CallbackServerContext& context,
                            Method method, const google::protobuf::MessageLite& request,
                            Handle handle, DeferredWork* deferred) {
  const auto caller = Admit(*parts.authenticator, context, method);
  if (!caller.ok()) return caller.status();
  if (auto status = CheckSize(**caller, request, parts.max_message_bytes); !status.ok()) {
    return status;
  }
  return handle(**caller, deferred);
}

}  // namespace

grpc::ServerUnaryReactor* AnswerUnary(const ServiceParts& parts,
                                      const grpc::CallbackServerContext& context, Method method,
                                      const google::protobuf::MessageLite& request, Handle handle) {
  const absl::Duration start = parts.clock->Now();
  auto* call = new UnaryCall(parts.calls, request);
  const absl::Status status =
      call->accepted() ? AdmitAndHandle(parts, context, method, request, handle, call->deferred())
                       : DrainingError();
  FinishCall(parts, method, start, status, call);
  return call;
}

grpc::ServerUnaryReactor* AnswerUnaryInBackground(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    std::function<absl::Status(const Credential& caller)> handle) {
  const absl::Duration start = parts.clock->Now();
  auto* call = new UnaryCall(parts.calls, request);
  const auto submit = [&](const Credential& caller, DeferredWork*) {
    return parts.worker->Submit([=, &caller, handle = std::move(handle)] {
      FinishCall(parts, method, start, handle(caller), call);
    });
  };
  const absl::Status accepted =
      call->accepted() ? AdmitAndHandle(parts, context, method, request, submit, call->deferred())
                       : DrainingError();
  if (!accepted.ok()) FinishCall(parts, method, start, accepted, call);
  return call;
}

}  // namespace spikeserve
