// PolicyService on gRPC's callback API: every method takes a call in, hands it to the request
// handler, records it and sends the answer.
#ifndef SERVER_RPC_POLICY_SERVICE_H_
#define SERVER_RPC_POLICY_SERVICE_H_

#include "server/rpc/arena_messages.h"
#include "server/rpc/service_parts.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {

// Thread-safe.
class PolicyService final : public v1::PolicyService::CallbackService {
 public:
  explicit PolicyService(const ServiceParts& parts) : parts_(parts) {
    SetMessageAllocatorFor_Act(&act_messages_);
    SetMessageAllocatorFor_ActBatch(&act_batch_messages_);
  }

  grpc::ServerUnaryReactor* ListPolicies(grpc::CallbackServerContext* context,
                                         const v1::ListPoliciesRequest* request,
                                         v1::ListPoliciesResponse* response) override;
  grpc::ServerUnaryReactor* OpenSession(grpc::CallbackServerContext* context,
                                        const v1::OpenSessionRequest* request,
                                        v1::OpenSessionResponse* response) override;
  grpc::ServerUnaryReactor* Act(grpc::CallbackServerContext* context, const v1::ActRequest* request,
                                v1::ActResponse* response) override;
  grpc::ServerUnaryReactor* ActBatch(grpc::CallbackServerContext* context,
                                     const v1::ActBatchRequest* request,
                                     v1::ActBatchResponse* response) override;
  grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>* ActStream(
      grpc::CallbackServerContext* context) override;
  grpc::ServerUnaryReactor* EndEpisode(grpc::CallbackServerContext* context,
                                       const v1::EndEpisodeRequest* request,
                                       v1::EndEpisodeResponse* response) override;
  grpc::ServerUnaryReactor* GetSession(grpc::CallbackServerContext* context,
                                       const v1::GetSessionRequest* request,
                                       v1::GetSessionResponse* response) override;
  grpc::ServerUnaryReactor* Explain(grpc::CallbackServerContext* context,
                                    const v1::ExplainRequest* request,
                                    v1::ExplainResponse* response) override;
  grpc::ServerUnaryReactor* CloseSession(grpc::CallbackServerContext* context,
                                         const v1::CloseSessionRequest* request,
                                         v1::CloseSessionResponse* response) override;

 private:
  const ServiceParts parts_;
  ArenaMessages<v1::ActRequest, v1::ActResponse> act_messages_;
  ArenaMessages<v1::ActBatchRequest, v1::ActBatchResponse> act_batch_messages_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_POLICY_SERVICE_H_
