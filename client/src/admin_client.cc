#include "spikeserve/admin_client.h"

#include <utility>

#include "absl/memory/memory.h"

namespace spikeserve {

using Stub = v1::PolicyAdmin::Stub;

absl::StatusOr<std::unique_ptr<AdminClient>> AdminClient::Connect(const std::string& servers,
                                                                  ClientOptions options,
                                                                  absl::Duration patience) {
  auto client = Client::Connect(servers, std::move(options), patience);
  if (!client.ok()) return client.status();
  return absl::WrapUnique(new AdminClient(*std::move(client)));
}

AdminClient::AdminClient(std::unique_ptr<Client> client) : client_(std::move(client)) {}

absl::StatusOr<v1::LoadPolicyResponse> AdminClient::LoadPolicy(
    const v1::LoadPolicyRequest& request) {
  return Call(&Stub::LoadPolicy, request, /*repeatable=*/true);
}

absl::StatusOr<v1::UnloadPolicyResponse> AdminClient::UnloadPolicy(
    const v1::UnloadPolicyRequest& request) {
  return Call(&Stub::UnloadPolicy, request, /*repeatable=*/false);
}

absl::StatusOr<v1::ReloadPoliciesResponse> AdminClient::ReloadPolicies(
    const v1::ReloadPoliciesRequest& request) {
  return Call(&Stub::ReloadPolicies, request, /*repeatable=*/true);
}

absl::StatusOr<v1::SetDefaultVersionResponse> AdminClient::SetDefaultVersion(
    const v1::SetDefaultVersionRequest& request) {
  return Call(&Stub::SetDefaultVersion, request, /*repeatable=*/true);
}

absl::StatusOr<v1::SetLabelResponse> AdminClient::SetLabel(const v1::SetLabelRequest& request) {
  return Call(&Stub::SetLabel, request, /*repeatable=*/true);
}

absl::StatusOr<v1::RemoveLabelResponse> AdminClient::RemoveLabel(
    const v1::RemoveLabelRequest& request) {
  return Call(&Stub::RemoveLabel, request, /*repeatable=*/false);
}

absl::StatusOr<v1::SetTrafficResponse> AdminClient::SetTraffic(
    const v1::SetTrafficRequest& request) {
  return Call(&Stub::SetTraffic, request, /*repeatable=*/true);
}

absl::StatusOr<v1::SetTrafficSharesResponse> AdminClient::SetTrafficShares(
    const v1::SetTrafficSharesRequest& request) {
  return Call(&Stub::SetTrafficShares, request, /*repeatable=*/true);
}

absl::StatusOr<v1::SetShadowResponse> AdminClient::SetShadow(const v1::SetShadowRequest& request) {
  return Call(&Stub::SetShadow, request, /*repeatable=*/true);
}

absl::StatusOr<v1::StartRolloutResponse> AdminClient::StartRollout(
    const v1::StartRolloutRequest& request) {
  return Call(&Stub::StartRollout, request, /*repeatable=*/false);
}

absl::StatusOr<v1::AbortRolloutResponse> AdminClient::AbortRollout(
    const v1::AbortRolloutRequest& request) {
  return Call(&Stub::AbortRollout, request, /*repeatable=*/false);
}

absl::StatusOr<v1::ListRolloutsResponse> AdminClient::ListRollouts(
    const v1::ListRolloutsRequest& request) {
  return Call(&Stub::ListRollouts, request, /*repeatable=*/true);
}

absl::StatusOr<v1::ListHistoryResponse> AdminClient::ListHistory(
    const v1::ListHistoryRequest& request) {
  return Call(&Stub::ListHistory, request, /*repeatable=*/true);
}

absl::StatusOr<v1::ListSessionsResponse> AdminClient::ListSessions(
    const v1::ListSessionsRequest& request) {
  return Call(&Stub::ListSessions, request, /*repeatable=*/true);
}

absl::StatusOr<v1::DrainResponse> AdminClient::Drain(const v1::DrainRequest& request) {
  return Call(&Stub::Drain, request, /*repeatable=*/true);
}

absl::StatusOr<v1::GetHeadResponse> AdminClient::GetHead(const v1::GetHeadRequest& request) {
  return Call(&Stub::GetHead, request, /*repeatable=*/true);
}

absl::StatusOr<v1::PromoteHeadResponse> AdminClient::PromoteHead(
    const v1::PromoteHeadRequest& request) {
  return Call(&Stub::PromoteHead, request, /*repeatable=*/false);
}

absl::StatusOr<v1::RollbackHeadResponse> AdminClient::RollbackHead(
    const v1::RollbackHeadRequest& request) {
  return Call(&Stub::RollbackHead, request, /*repeatable=*/false);
}

absl::StatusOr<v1::PauseLearningResponse> AdminClient::PauseLearning(
    const v1::PauseLearningRequest& request) {
  return Call(&Stub::PauseLearning, request, /*repeatable=*/true);
}

absl::StatusOr<v1::ResumeLearningResponse> AdminClient::ResumeLearning(
    const v1::ResumeLearningRequest& request) {
  return Call(&Stub::ResumeLearning, request, /*repeatable=*/true);
}

}  // namespace spikeserve
