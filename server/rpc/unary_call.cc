#include "server/rpc/unary_call.h"

#include <grpcpp/alarm.h>

#include <chrono>
#include <cstdint>
#include <utility>

#include "absl/time/time.h"
#include "server/access/admission.h"
#include "server/rpc/status_map.h"

namespace spikeserve {
namespace {

int64_t ByteSize(const google::protobuf::MessageLite& message) {
  return static_cast<int64_t>(message.ByteSizeLong());
}

// Keeps a unary call in the tracker until gRPC has sent its answer. gRPC sends the answer after the
// method has returned, so deferred work runs in OnDone.
class UnaryCall final : public grpc::ServerUnaryReactor {
 public:
  UnaryCall(const ServiceParts& parts, Method method, const google::protobuf::MessageLite& request)
      : parts_(parts),
        method_(method),
        request_(request),
        start_(parts.clock->Now()),
        accepted_(parts.calls->Begin()) {}

  bool accepted() const { return accepted_; }
  DeferredWork* deferred() { return &deferred_; }

  // Records the call and sends its status, now or, if the call was refused, after a delay, so that
  // the caller cannot retry at once.
  void End(const absl::StatusOr<const Credential*>& caller, const CallOutcome& outcome) {
    const absl::Duration now = parts_.clock->Now();
    const absl::Status& status = outcome.status;
    parts_.metrics->ObserveRpc(method_, status.code(), now - start_);
    if (outcome.refusal.ok()) return Finish(ToGrpcStatus(status));
    RefusalPacer& refusals = parts_.authenticator->RefusalPacerFor(caller);
    const absl::Duration delay = refusals.DelayFor(outcome.refusal, request_.ByteSizeLong(), now);
    if (delay == absl::ZeroDuration()) return Finish(ToGrpcStatus(status));
    alarm_.Set(std::chrono::system_clock::now() + absl::ToChronoNanoseconds(delay),
               [this, status](bool /*ok*/) { Finish(ToGrpcStatus(status)); });
  }

  void OnDone() override {
    deferred_.Run();
    parts_.calls->End();
    delete this;  // gRPC calls OnDone once and does not use the reactor afterwards
  }

  // Lets gRPC run OnDone on the thread that has sent the answer instead of waking another one. gRPC
  // intends this for reactors that never block. This one may block on a session's lock, for as long
  // as a decision of that session takes.
  bool InternalInlineable() override { return true; }

 private:
  const ServiceParts& parts_;
  const Method method_;
  const google::protobuf::MessageLite& request_;  // owned by gRPC, valid until OnDone
  const absl::Duration start_;
  const bool accepted_;
  DeferredWork deferred_;
  grpc::Alarm alarm_;
};

// Returns the caller, or why it is not admitted. Sets `status` to the first error of the admission
// and of the size check, or to OK.
absl::StatusOr<const Credential*> AdmitAccepted(const ServiceParts& parts,
                                                const grpc::CallbackServerContext& context,
                                                Method method,
                                                const google::protobuf::MessageLite& request,
                                                const UnaryCall& call, absl::Status* status) {
  auto caller = call.accepted() ? AdmitCaller(parts, context, method) : DrainingError();
  *status = caller.status();
  if (caller.ok()) *status = CheckSize(**caller, ByteSize(request), parts.max_message_bytes);
  return caller;
}

}  // namespace

absl::StatusOr<const Credential*> AdmitCaller(const ServiceParts& parts,
                                              const grpc::CallbackServerContext& context,
                                              Method method) {
  const auto& metadata = context.client_metadata();
  const auto header = metadata.find("authorization");
  if (header == metadata.end()) return Admit(*parts.authenticator, "", method);
  return Admit(*parts.authenticator, {header->second.data(), header->second.size()}, method);
}

grpc::ServerUnaryReactor* AnswerUnary(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    absl::FunctionRef<CallOutcome(const Credential& caller, DeferredWork*)> handle) {
  auto* call = new UnaryCall(parts, method, request);
  absl::Status status;
  const auto caller = AdmitAccepted(parts, context, method, request, *call, &status);
  call->End(caller, status.ok() ? handle(**caller, call->deferred()) : CallOutcome(status));
  return call;
}

grpc::ServerUnaryReactor* AnswerUnaryInBackground(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    std::function<absl::Status(const Credential& caller)> handle) {
  auto* call = new UnaryCall(parts, method, request);
  absl::Status status;
  const auto caller = AdmitAccepted(parts, context, method, request, *call, &status);
  if (status.ok()) {
    status = parts.worker->Submit([call, caller, handle = std::move(handle)] {
      call->End(caller, CallOutcome(handle(**caller)));
    });
  }
  if (!status.ok()) call->End(caller, CallOutcome(status));
  return call;
}

}  // namespace spikeserve
