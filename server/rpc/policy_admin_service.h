// PolicyAdmin on gRPC's callback API: every method takes a call in, hands it to the handler,
// records it and sends the answer. Methods that are not here answer UNIMPLEMENTED.
#ifndef SERVER_RPC_POLICY_ADMIN_SERVICE_H_
#define SERVER_RPC_POLICY_ADMIN_SERVICE_H_

#include "server/admin/head_admin.h"
#include "server/admin/policy_admin_handler.h"
#include "server/rpc/service_parts.h"
#include "spikeserve/v1/policy_admin.grpc.pb.h"

namespace spikeserve {

// Thread-safe.
class PolicyAdminService final : public v1::PolicyAdmin::CallbackService {
 public:
  // `admin` and `heads` must outlive the service.
  PolicyAdminService(const ServiceParts& parts, const PolicyAdminHandler* admin,
                     const HeadAdmin* heads)
      : parts_(parts), admin_(admin), heads_(heads) {}

  grpc::ServerUnaryReactor* LoadPolicy(grpc::CallbackServerContext* context,
                                       const v1::LoadPolicyRequest* request,
                                       v1::LoadPolicyResponse* response) override;
  grpc::ServerUnaryReactor* UnloadPolicy(grpc::CallbackServerContext* context,
                                         const v1::UnloadPolicyRequest* request,
                                         v1::UnloadPolicyResponse* response) override;
  grpc::ServerUnaryReactor* ReloadPolicies(grpc::CallbackServerContext* context,
                                           const v1::ReloadPoliciesRequest* request,
                                           v1::ReloadPoliciesResponse* response) override;
  grpc::ServerUnaryReactor* SetDefaultVersion(grpc::CallbackServerContext* context,
                                              const v1::SetDefaultVersionRequest* request,
                                              v1::SetDefaultVersionResponse* response) override;
  grpc::ServerUnaryReactor* SetLabel(grpc::CallbackServerContext* context,
                                     const v1::SetLabelRequest* request,
                                     v1::SetLabelResponse* response) override;
  grpc::ServerUnaryReactor* RemoveLabel(grpc::CallbackServerContext* context,
                                        const v1::RemoveLabelRequest* request,
                                        v1::RemoveLabelResponse* response) override;
  grpc::ServerUnaryReactor* SetTraffic(grpc::CallbackServerContext* context,
                                       const v1::SetTrafficRequest* request,
                                       v1::SetTrafficResponse* response) override;
  grpc::ServerUnaryReactor* ListSessions(grpc::CallbackServerContext* context,
                                         const v1::ListSessionsRequest* request,
                                         v1::ListSessionsResponse* response) override;
  grpc::ServerUnaryReactor* Drain(grpc::CallbackServerContext* context,
                                  const v1::DrainRequest* request,
                                  v1::DrainResponse* response) override;
  grpc::ServerUnaryReactor* GetHead(grpc::CallbackServerContext* context,
                                    const v1::GetHeadRequest* request,
                                    v1::GetHeadResponse* response) override;
  grpc::ServerUnaryReactor* PromoteHead(grpc::CallbackServerContext* context,
                                        const v1::PromoteHeadRequest* request,
                                        v1::PromoteHeadResponse* response) override;
  grpc::ServerUnaryReactor* RollbackHead(grpc::CallbackServerContext* context,
                                         const v1::RollbackHeadRequest* request,
                                         v1::RollbackHeadResponse* response) override;
  grpc::ServerUnaryReactor* PauseLearning(grpc::CallbackServerContext* context,
                                          const v1::PauseLearningRequest* request,
                                          v1::PauseLearningResponse* response) override;
  grpc::ServerUnaryReactor* ResumeLearning(grpc::CallbackServerContext* context,
                                           const v1::ResumeLearningRequest* request,
                                           v1::ResumeLearningResponse* response) override;

 private:
  const ServiceParts parts_;
  const PolicyAdminHandler* const admin_;
  const HeadAdmin* const heads_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_POLICY_ADMIN_SERVICE_H_
