#include "server/policy_service.h"

#include "server/unary_call.h"

namespace spikeserve {
grpc::ServerUnaryReactor* PolicyService::Unary(Method method, Handle handle) {
  return AnswerUnary(parts_, method, handle);
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
