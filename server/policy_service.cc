#include "server/policy_service.h"

#include <utility>

#include "server/status_map.h"

namespace spikeserve {
namespace {

// Keeps a unary call on the books until gRPC has sent its answer. gRPC sends once the method has
// returned, so what may wait is done in OnDone.
class UnaryCall final : public grpc::ServerUnaryReactor {
 public:
  explicit UnaryCall(CallTracker* calls) : calls_(calls), accepted_(calls->Begin()) {}

  bool accepted() const { return accepted_; }
  DeferredWork* deferred() { return &deferred_; }

  void OnDone() override {
    deferred_.Run();
    calls_->End();
    delete this;  // gRPC's reactors own themselves
  }

 private:
  CallTracker* const calls_;
  const bool accepted_;
  DeferredWork deferred_;
};

}  // namespace

grpc::ServerUnaryReactor* PolicyService::Unary(Method method, Handle handle) {
  const absl::Duration start = parts_.clock->Now();
  auto* call = new UnaryCall(parts_.calls);
  const absl::Status status = call->accepted() ? handle(call->deferred()) : DrainingError();
  parts_.metrics->ObserveRpc(method, status.code(), parts_.clock->Now() - start);
  call->Finish(ToGrpcStatus(status));
  return call;
}

grpc::ServerUnaryReactor* PolicyService::ListPolicies(grpc::CallbackServerContext*,
                                                      const v1::ListPoliciesRequest* request,
                                                      v1::ListPoliciesResponse* response) {
  return Unary(Method::kListPolicies,
               [&](DeferredWork*) { return parts_.handler->ListPolicies(*request, response); });
}

grpc::ServerUnaryReactor* PolicyService::OpenSession(grpc::CallbackServerContext*,
                                                     const v1::OpenSessionRequest* request,
                                                     v1::OpenSessionResponse* response) {
  return Unary(Method::kOpenSession,
               [&](DeferredWork*) { return parts_.handler->OpenSession(*request, response); });
}

grpc::ServerUnaryReactor* PolicyService::Act(grpc::CallbackServerContext*,
                                             const v1::ActRequest* request,
                                             v1::ActResponse* response) {
  return Unary(Method::kAct, [&](DeferredWork* deferred) {
    return parts_.handler->Act(*request, response, deferred);
  });
}

grpc::ServerUnaryReactor* PolicyService::ActBatch(grpc::CallbackServerContext*,
                                                  const v1::ActBatchRequest* request,
                                                  v1::ActBatchResponse* response) {
  return Unary(Method::kActBatch, [&](DeferredWork* deferred) {
    return parts_.handler->ActBatch(*request, response, deferred);
  });
}

grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>* PolicyService::ActStream(
    grpc::CallbackServerContext*) {
  return spikeserve::ActStream::Start(parts_);
}

grpc::ServerUnaryReactor* PolicyService::EndEpisode(grpc::CallbackServerContext*,
                                                    const v1::EndEpisodeRequest* request,
                                                    v1::EndEpisodeResponse* response) {
  return Unary(Method::kEndEpisode,
               [&](DeferredWork*) { return parts_.handler->EndEpisode(*request, response); });
}

grpc::ServerUnaryReactor* PolicyService::GetSession(grpc::CallbackServerContext*,
                                                    const v1::GetSessionRequest* request,
                                                    v1::GetSessionResponse* response) {
  return Unary(Method::kGetSession,
               [&](DeferredWork*) { return parts_.handler->GetSession(*request, response); });
}

grpc::ServerUnaryReactor* PolicyService::CloseSession(grpc::CallbackServerContext*,
                                                      const v1::CloseSessionRequest* request,
                                                      v1::CloseSessionResponse* response) {
  return Unary(Method::kCloseSession,
               [&](DeferredWork*) { return parts_.handler->CloseSession(*request, response); });
}

}  // namespace spikeserve
