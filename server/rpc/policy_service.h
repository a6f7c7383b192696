// PolicyService on gRPC's callback API. Forwards every method to PolicyHandler.
#ifndef SERVER_RPC_POLICY_SERVICE_H_
#define SERVER_RPC_POLICY_SERVICE_H_

#include "server/agent/policy_handler.h"
#include "server/rpc/arena_messages.h"
#include "server/rpc/forward.h"
#include "server/rpc/service_parts.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {

// Thread-safe.
class PolicyService final : public v1::PolicyService::CallbackService {
 public:
  // `handler` must outlive the service.
  PolicyService(const ServiceParts& parts, const PolicyHandler* handler)
      : parts_(parts), handler_(handler) {
    SetMessageAllocatorFor_Act(&act_messages_);
    SetMessageAllocatorFor_ActBatch(&act_batch_messages_);
  }

  grpc::ServerUnaryReactor* ListPolicies(grpc::CallbackServerContext* context,
                                         const v1::ListPoliciesRequest* request,
                                         v1::ListPoliciesResponse* response) override {
    return Forward(parts_, Method::kListPolicies, context, request, response, handler_,
                   &PolicyHandler::ListPolicies);
  }
  grpc::ServerUnaryReactor* OpenSession(grpc::CallbackServerContext* context,
                                        const v1::OpenSessionRequest* request,
                                        v1::OpenSessionResponse* response) override {
    return Forward(parts_, Method::kOpenSession, context, request, response, handler_,
                   &PolicyHandler::OpenSession);
  }
  grpc::ServerUnaryReactor* Act(grpc::CallbackServerContext* context, const v1::ActRequest* request,
                                v1::ActResponse* response) override {
    return Forward(parts_, Method::kAct, context, request, response, handler_, &PolicyHandler::Act);
  }
  grpc::ServerUnaryReactor* ActBatch(grpc::CallbackServerContext* context,
                                     const v1::ActBatchRequest* request,
                                     v1::ActBatchResponse* response) override;
  grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>* ActStream(
      grpc::CallbackServerContext* context) override;
  grpc::ServerUnaryReactor* EndEpisode(grpc::CallbackServerContext* context,
                                       const v1::EndEpisodeRequest* request,
                                       v1::EndEpisodeResponse* response) override {
    return Forward(parts_, Method::kEndEpisode, context, request, response, handler_,
                   &PolicyHandler::EndEpisode);
  }
  grpc::ServerUnaryReactor* GetSession(grpc::CallbackServerContext* context,
                                       const v1::GetSessionRequest* request,
                                       v1::GetSessionResponse* response) override {
    return Forward(parts_, Method::kGetSession, context, request, response, handler_,
                   &PolicyHandler::GetSession);
  }
  grpc::ServerUnaryReactor* Explain(grpc::CallbackServerContext* context,
                                    const v1::ExplainRequest* request,
                                    v1::ExplainResponse* response) override {
    return ForwardInBackground(parts_, Method::kExplain, context, request, response, handler_,
                               &PolicyHandler::Explain);
  }
  grpc::ServerUnaryReactor* CloseSession(grpc::CallbackServerContext* context,
                                         const v1::CloseSessionRequest* request,
                                         v1::CloseSessionResponse* response) override {
    return Forward(parts_, Method::kCloseSession, context, request, response, handler_,
                   &PolicyHandler::CloseSession);
  }

 private:
  const ServiceParts parts_;
  const PolicyHandler* const handler_;
  ArenaMessages<v1::ActRequest, v1::ActResponse> act_messages_;
  ArenaMessages<v1::ActBatchRequest, v1::ActBatchResponse> act_batch_messages_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_POLICY_SERVICE_H_
