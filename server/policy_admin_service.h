// PolicyAdmin on gRPC's callback API: every method takes a call in, hands it to the handler,
// records it and sends the answer. Methods that are not here answer UNIMPLEMENTED.
#ifndef SERVER_POLICY_ADMIN_SERVICE_H_
#define SERVER_POLICY_ADMIN_SERVICE_H_

#include "server/act_stream.h"
#include "server/policy_admin_handler.h"
#include "spikeserve/v1/policy_admin.grpc.pb.h"

namespace spikeserve {

// Thread-safe.
class PolicyAdminService final : public v1::PolicyAdmin::CallbackService {
 public:
  // `admin` must outlive the service.
  PolicyAdminService(const ServiceParts& parts, const PolicyAdminHandler* admin)
      : parts_(parts), admin_(admin) {}

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

 private:
  const ServiceParts parts_;
  const PolicyAdminHandler* const admin_;
};

}  // namespace spikeserve

#endif  // SERVER_POLICY_ADMIN_SERVICE_H_
