// PolicyAdmin on gRPC's callback API. Forwards every method to AdminHandler or HeadHandler on the
// background worker, because some methods read and write files.
#ifndef SERVER_RPC_POLICY_ADMIN_SERVICE_H_
#define SERVER_RPC_POLICY_ADMIN_SERVICE_H_

#include "server/admin/admin_handler.h"
#include "server/admin/head_handler.h"
#include "server/rpc/forward.h"
#include "server/rpc/service_parts.h"
#include "spikeserve/v1/policy_admin.grpc.pb.h"

namespace spikeserve {

// Thread-safe.
class PolicyAdminService final : public v1::PolicyAdmin::CallbackService {
 public:
  // `admin` and `heads` must outlive the service.
  PolicyAdminService(const ServiceParts& parts, const AdminHandler* admin, const HeadHandler* heads)
      : parts_(parts), admin_(admin), heads_(heads) {}

  grpc::ServerUnaryReactor* LoadPolicy(grpc::CallbackServerContext* context,
                                       const v1::LoadPolicyRequest* request,
                                       v1::LoadPolicyResponse* response) override {
    return ForwardInBackground(parts_, Method::kLoadPolicy, context, request, response, admin_,
                               &AdminHandler::LoadPolicy);
  }
  grpc::ServerUnaryReactor* UnloadPolicy(grpc::CallbackServerContext* context,
                                         const v1::UnloadPolicyRequest* request,
                                         v1::UnloadPolicyResponse* response) override {
    return ForwardInBackground(parts_, Method::kUnloadPolicy, context, request, response, admin_,
                               &AdminHandler::UnloadPolicy);
  }
  grpc::ServerUnaryReactor* ReloadPolicies(grpc::CallbackServerContext* context,
                                           const v1::ReloadPoliciesRequest* request,
                                           v1::ReloadPoliciesResponse* response) override {
    return ForwardInBackground(parts_, Method::kReloadPolicies, context, request, response, admin_,
                               &AdminHandler::ReloadPolicies);
  }
  grpc::ServerUnaryReactor* SetDefaultVersion(grpc::CallbackServerContext* context,
                                              const v1::SetDefaultVersionRequest* request,
                                              v1::SetDefaultVersionResponse* response) override {
    return ForwardInBackground(parts_, Method::kSetDefaultVersion, context, request, response,
                               admin_, &AdminHandler::SetDefaultVersion);
  }
  grpc::ServerUnaryReactor* SetLabel(grpc::CallbackServerContext* context,
                                     const v1::SetLabelRequest* request,
                                     v1::SetLabelResponse* response) override {
    return ForwardInBackground(parts_, Method::kSetLabel, context, request, response, admin_,
                               &AdminHandler::SetLabel);
  }
  grpc::ServerUnaryReactor* RemoveLabel(grpc::CallbackServerContext* context,
                                        const v1::RemoveLabelRequest* request,
                                        v1::RemoveLabelResponse* response) override {
    return ForwardInBackground(parts_, Method::kRemoveLabel, context, request, response, admin_,
                               &AdminHandler::RemoveLabel);
  }
  grpc::ServerUnaryReactor* SetTraffic(grpc::CallbackServerContext* context,
                                       const v1::SetTrafficRequest* request,
                                       v1::SetTrafficResponse* response) override {
    return ForwardInBackground(parts_, Method::kSetTraffic, context, request, response, admin_,
                               &AdminHandler::SetTraffic);
  }
  grpc::ServerUnaryReactor* ListSessions(grpc::CallbackServerContext* context,
                                         const v1::ListSessionsRequest* request,
                                         v1::ListSessionsResponse* response) override {
    return ForwardInBackground(parts_, Method::kListSessions, context, request, response, admin_,
                               &AdminHandler::ListSessions);
  }
  grpc::ServerUnaryReactor* Drain(grpc::CallbackServerContext* context,
                                  const v1::DrainRequest* request,
                                  v1::DrainResponse* response) override {
    return ForwardInBackground(parts_, Method::kDrain, context, request, response, admin_,
                               &AdminHandler::Drain);
  }
  grpc::ServerUnaryReactor* GetHead(grpc::CallbackServerContext* context,
                                    const v1::GetHeadRequest* request,
                                    v1::GetHeadResponse* response) override {
    return ForwardInBackground(parts_, Method::kGetHead, context, request, response, heads_,
                               &HeadHandler::GetHead);
  }
  grpc::ServerUnaryReactor* PromoteHead(grpc::CallbackServerContext* context,
                                        const v1::PromoteHeadRequest* request,
                                        v1::PromoteHeadResponse* response) override {
    return ForwardInBackground(parts_, Method::kPromoteHead, context, request, response, heads_,
                               &HeadHandler::PromoteHead);
  }
  grpc::ServerUnaryReactor* RollbackHead(grpc::CallbackServerContext* context,
                                         const v1::RollbackHeadRequest* request,
                                         v1::RollbackHeadResponse* response) override {
    return ForwardInBackground(parts_, Method::kRollbackHead, context, request, response, heads_,
                               &HeadHandler::RollbackHead);
  }
  grpc::ServerUnaryReactor* PauseLearning(grpc::CallbackServerContext* context,
                                          const v1::PauseLearningRequest* request,
                                          v1::PauseLearningResponse* response) override {
    return ForwardInBackground(parts_, Method::kPauseLearning, context, request, response, heads_,
                               &HeadHandler::PauseLearning);
  }
  grpc::ServerUnaryReactor* ResumeLearning(grpc::CallbackServerContext* context,
                                           const v1::ResumeLearningRequest* request,
                                           v1::ResumeLearningResponse* response) override {
    return ForwardInBackground(parts_, Method::kResumeLearning, context, request, response, heads_,
                               &HeadHandler::ResumeLearning);
  }

 private:
  const ServiceParts parts_;
  const AdminHandler* const admin_;
  const HeadHandler* const heads_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_POLICY_ADMIN_SERVICE_H_
