#include "server/policy_admin_service.h"

#include "server/unary_call.h"

namespace spikeserve {

grpc::ServerUnaryReactor* PolicyAdminService::LoadPolicy(grpc::CallbackServerContext*,
                                                         const v1::LoadPolicyRequest* request,
                                                         v1::LoadPolicyResponse* response) {
  return AnswerUnary(parts_, Method::kLoadPolicy,
                     [&](DeferredWork*) { return admin_->LoadPolicy(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::UnloadPolicy(grpc::CallbackServerContext*,
                                                           const v1::UnloadPolicyRequest* request,
                                                           v1::UnloadPolicyResponse* response) {
  return AnswerUnary(parts_, Method::kUnloadPolicy,
                     [&](DeferredWork*) { return admin_->UnloadPolicy(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::ReloadPolicies(
    grpc::CallbackServerContext*, const v1::ReloadPoliciesRequest* request,
    v1::ReloadPoliciesResponse* response) {
  return AnswerUnary(parts_, Method::kReloadPolicies,
                     [&](DeferredWork*) { return admin_->ReloadPolicies(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::SetDefaultVersion(
    grpc::CallbackServerContext*, const v1::SetDefaultVersionRequest* request,
    v1::SetDefaultVersionResponse* response) {
  return AnswerUnary(parts_, Method::kSetDefaultVersion,
                     [&](DeferredWork*) { return admin_->SetDefaultVersion(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::SetLabel(grpc::CallbackServerContext*,
                                                       const v1::SetLabelRequest* request,
                                                       v1::SetLabelResponse* response) {
  return AnswerUnary(parts_, Method::kSetLabel,
                     [&](DeferredWork*) { return admin_->SetLabel(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::RemoveLabel(grpc::CallbackServerContext*,
                                                          const v1::RemoveLabelRequest* request,
                                                          v1::RemoveLabelResponse* response) {
  return AnswerUnary(parts_, Method::kRemoveLabel,
                     [&](DeferredWork*) { return admin_->RemoveLabel(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::SetTraffic(grpc::CallbackServerContext*,
                                                         const v1::SetTrafficRequest* request,
                                                         v1::SetTrafficResponse* response) {
  return AnswerUnary(parts_, Method::kSetTraffic,
                     [&](DeferredWork*) { return admin_->SetTraffic(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::ListSessions(grpc::CallbackServerContext*,
                                                           const v1::ListSessionsRequest* request,
                                                           v1::ListSessionsResponse* response) {
  return AnswerUnary(parts_, Method::kListSessions,
                     [&](DeferredWork*) { return admin_->ListSessions(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::Drain(grpc::CallbackServerContext*,
                                                    const v1::DrainRequest* request,
                                                    v1::DrainResponse* response) {
  return AnswerUnary(parts_, Method::kDrain,
                     [&](DeferredWork*) { return admin_->Drain(*request, response); });
}

}  // namespace spikeserve
