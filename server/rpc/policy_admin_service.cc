#include "server/rpc/policy_admin_service.h"

#include "server/rpc/unary_call.h"

namespace spikeserve {

grpc::ServerUnaryReactor* PolicyAdminService::LoadPolicy(grpc::CallbackServerContext* context,
                                                         const v1::LoadPolicyRequest* request,
                                                         v1::LoadPolicyResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kLoadPolicy, *request,
      [=, this](const Credential&) { return admin_->LoadPolicy(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::UnloadPolicy(grpc::CallbackServerContext* context,
                                                           const v1::UnloadPolicyRequest* request,
                                                           v1::UnloadPolicyResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kUnloadPolicy, *request,
      [=, this](const Credential&) { return admin_->UnloadPolicy(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::ReloadPolicies(
    grpc::CallbackServerContext* context, const v1::ReloadPoliciesRequest* request,
    v1::ReloadPoliciesResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kReloadPolicies, *request,
      [=, this](const Credential&) { return admin_->ReloadPolicies(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::SetDefaultVersion(
    grpc::CallbackServerContext* context, const v1::SetDefaultVersionRequest* request,
    v1::SetDefaultVersionResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kSetDefaultVersion, *request,
      [=, this](const Credential&) { return admin_->SetDefaultVersion(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::SetLabel(grpc::CallbackServerContext* context,
                                                       const v1::SetLabelRequest* request,
                                                       v1::SetLabelResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kSetLabel, *request,
      [=, this](const Credential&) { return admin_->SetLabel(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::RemoveLabel(grpc::CallbackServerContext* context,
                                                          const v1::RemoveLabelRequest* request,
                                                          v1::RemoveLabelResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kRemoveLabel, *request,
      [=, this](const Credential&) { return admin_->RemoveLabel(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::SetTraffic(grpc::CallbackServerContext* context,
                                                         const v1::SetTrafficRequest* request,
                                                         v1::SetTrafficResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kSetTraffic, *request,
      [=, this](const Credential&) { return admin_->SetTraffic(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::ListSessions(grpc::CallbackServerContext* context,
                                                           const v1::ListSessionsRequest* request,
                                                           v1::ListSessionsResponse* response) {
  return AnswerUnaryInBackground(parts_, *context, Method::kListSessions, *request,
                                 [=, this](const Credential& caller) {
                                   return admin_->ListSessions(caller, *request, response);
                                 });
}

grpc::ServerUnaryReactor* PolicyAdminService::Drain(grpc::CallbackServerContext* context,
                                                    const v1::DrainRequest* request,
                                                    v1::DrainResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kDrain, *request,
      [=, this](const Credential&) { return admin_->Drain(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::GetHead(grpc::CallbackServerContext* context,
                                                      const v1::GetHeadRequest* request,
                                                      v1::GetHeadResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kGetHead, *request,
      [=, this](const Credential&) { return heads_->GetHead(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::PromoteHead(grpc::CallbackServerContext* context,
                                                          const v1::PromoteHeadRequest* request,
                                                          v1::PromoteHeadResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kPromoteHead, *request,
      [=, this](const Credential&) { return heads_->PromoteHead(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::RollbackHead(grpc::CallbackServerContext* context,
                                                           const v1::RollbackHeadRequest* request,
                                                           v1::RollbackHeadResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kRollbackHead, *request,
      [=, this](const Credential&) { return heads_->RollbackHead(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::PauseLearning(grpc::CallbackServerContext* context,
                                                            const v1::PauseLearningRequest* request,
                                                            v1::PauseLearningResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kPauseLearning, *request,
      [=, this](const Credential&) { return heads_->PauseLearning(*request, response); });
}

grpc::ServerUnaryReactor* PolicyAdminService::ResumeLearning(
    grpc::CallbackServerContext* context, const v1::ResumeLearningRequest* request,
    v1::ResumeLearningResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kResumeLearning, *request,
      [=, this](const Credential&) { return heads_->ResumeLearning(*request, response); });
}

}  // namespace spikeserve
