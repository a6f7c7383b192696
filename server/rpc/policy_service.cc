#include "server/rpc/policy_service.h"

#include <memory>
#include <utility>

#include "server/access/admission.h"
#include "server/rpc/act_stream.h"
#include "server/rpc/unary_call.h"

namespace spikeserve {

grpc::ServerUnaryReactor* PolicyService::ListPolicies(grpc::CallbackServerContext* context,
                                                      const v1::ListPoliciesRequest* request,
                                                      v1::ListPoliciesResponse* response) {
  return AnswerUnary(parts_, *context, Method::kListPolicies, *request,
                     [&](const Credential&, DeferredWork*) {
                       return parts_.handler->ListPolicies(*request, response);
                     });
}

grpc::ServerUnaryReactor* PolicyService::OpenSession(grpc::CallbackServerContext* context,
                                                     const v1::OpenSessionRequest* request,
                                                     v1::OpenSessionResponse* response) {
  return AnswerUnary(parts_, *context, Method::kOpenSession, *request,
                     [&](const Credential& caller, DeferredWork*) {
                       return parts_.handler->OpenSession(caller, *request, response);
                     });
}

grpc::ServerUnaryReactor* PolicyService::Act(grpc::CallbackServerContext* context,
                                             const v1::ActRequest* request,
                                             v1::ActResponse* response) {
  return AnswerUnary(parts_, *context, Method::kAct, *request,
                     [&](const Credential& caller, DeferredWork* deferred) {
                       return parts_.handler->Act(caller, *request, response, deferred);
                     });
}

grpc::ServerUnaryReactor* PolicyService::ActBatch(grpc::CallbackServerContext* context,
                                                  const v1::ActBatchRequest* request,
                                                  v1::ActBatchResponse* response) {
  return AnswerUnary(parts_, *context, Method::kActBatch, *request,
                     [&](const Credential& caller, DeferredWork* deferred) {
                       return parts_.handler->ActBatch(caller, *request, response, deferred);
                     });
}

grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>* PolicyService::ActStream(
    grpc::CallbackServerContext* context) {
  return spikeserve::ActStream::Begin(std::make_shared<spikeserve::ActStream>(
      parts_, Admit(*parts_.authenticator, *context, Method::kActStream)));
}

grpc::ServerUnaryReactor* PolicyService::EndEpisode(grpc::CallbackServerContext* context,
                                                    const v1::EndEpisodeRequest* request,
                                                    v1::EndEpisodeResponse* response) {
  return AnswerUnary(parts_, *context, Method::kEndEpisode, *request,
                     [&](const Credential& caller, DeferredWork*) {
                       return parts_.handler->EndEpisode(caller, *request, response);
                     });
}

grpc::ServerUnaryReactor* PolicyService::GetSession(grpc::CallbackServerContext* context,
                                                    const v1::GetSessionRequest* request,
                                                    v1::GetSessionResponse* response) {
  return AnswerUnary(parts_, *context, Method::kGetSession, *request,
                     [&](const Credential& caller, DeferredWork*) {
                       return parts_.handler->GetSession(caller, *request, response);
                     });
}

grpc::ServerUnaryReactor* PolicyService::Explain(grpc::CallbackServerContext* context,
                                                 const v1::ExplainRequest* request,
                                                 v1::ExplainResponse* response) {
  return AnswerUnaryInBackground(parts_, *context, Method::kExplain, *request,
                                 [=, this](const Credential& caller) {
                                   return parts_.handler->Explain(caller, *request, response);
                                 });
}

grpc::ServerUnaryReactor* PolicyService::CloseSession(grpc::CallbackServerContext* context,
                                                      const v1::CloseSessionRequest* request,
                                                      v1::CloseSessionResponse* response) {
  return AnswerUnary(parts_, *context, Method::kCloseSession, *request,
                     [&](const Credential& caller, DeferredWork*) {
                       return parts_.handler->CloseSession(caller, *request, response);
                     });
}

}  // namespace spikeserve
