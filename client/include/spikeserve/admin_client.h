// Calls the methods of PolicyAdmin, which operators use. policy_admin.proto describes them.
//
//   auto admin = AdminClient::Connect("127.0.0.1:50051");
//   v1::SetDefaultVersionRequest request;
//   request.set_policy("cartpole");
//   auto response = (*admin)->SetDefaultVersion(request);
//
// With several servers (Client), a call goes to any of them that answers.
//
// Thread-safe.
#ifndef SPIKESERVE_ADMIN_CLIENT_H_
#define SPIKESERVE_ADMIN_CLIENT_H_

#include <grpcpp/client_context.h>

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "spikeserve/client.h"
#include "spikeserve/v1/policy_admin.grpc.pb.h"

namespace spikeserve {

// Longer than the timeout of a decision, because loading a version reads files and tries the
// policy.
inline constexpr absl::Duration kAdminTimeout = absl::Seconds(60);

class AdminClient {
 public:
  // As Client::Connect. `options.call_timeout` is ignored: each attempt may take kAdminTimeout.
  static absl::StatusOr<std::unique_ptr<AdminClient>> Connect(
      const std::string& servers, ClientOptions options = {},
      absl::Duration patience = absl::Seconds(3));

  // Every method returns the server's code and message on an error. Methods that have the same
  // effect if they are carried out twice are repeated as `options.retry` says. UnloadPolicy,
  // RemoveLabel, StartRollout, AbortRollout, PromoteHead and RollbackHead are repeated only if the
  // server refused them for now.
  absl::StatusOr<v1::LoadPolicyResponse> LoadPolicy(const v1::LoadPolicyRequest& request);
  absl::StatusOr<v1::UnloadPolicyResponse> UnloadPolicy(const v1::UnloadPolicyRequest& request);
  absl::StatusOr<v1::ReloadPoliciesResponse> ReloadPolicies(
      const v1::ReloadPoliciesRequest& request);
  absl::StatusOr<v1::SetDefaultVersionResponse> SetDefaultVersion(
      const v1::SetDefaultVersionRequest& request);
  absl::StatusOr<v1::SetLabelResponse> SetLabel(const v1::SetLabelRequest& request);
  absl::StatusOr<v1::RemoveLabelResponse> RemoveLabel(const v1::RemoveLabelRequest& request);
  absl::StatusOr<v1::SetTrafficResponse> SetTraffic(const v1::SetTrafficRequest& request);
  absl::StatusOr<v1::SetTrafficSharesResponse> SetTrafficShares(
      const v1::SetTrafficSharesRequest& request);
  absl::StatusOr<v1::SetShadowResponse> SetShadow(const v1::SetShadowRequest& request);
  absl::StatusOr<v1::StartRolloutResponse> StartRollout(const v1::StartRolloutRequest& request);
  absl::StatusOr<v1::AbortRolloutResponse> AbortRollout(const v1::AbortRolloutRequest& request);
  absl::StatusOr<v1::ListRolloutsResponse> ListRollouts(const v1::ListRolloutsRequest& request);
  absl::StatusOr<v1::ListHistoryResponse> ListHistory(const v1::ListHistoryRequest& request);
  absl::StatusOr<v1::ListSessionsResponse> ListSessions(const v1::ListSessionsRequest& request);
  absl::StatusOr<v1::DrainResponse> Drain(const v1::DrainRequest& request);
  absl::StatusOr<v1::GetHeadResponse> GetHead(const v1::GetHeadRequest& request);
  absl::StatusOr<v1::PromoteHeadResponse> PromoteHead(const v1::PromoteHeadRequest& request);
  absl::StatusOr<v1::RollbackHeadResponse> RollbackHead(const v1::RollbackHeadRequest& request);
  absl::StatusOr<v1::PauseLearningResponse> PauseLearning(const v1::PauseLearningRequest& request);
  absl::StatusOr<v1::ResumeLearningResponse> ResumeLearning(
      const v1::ResumeLearningRequest& request);

  // Makes the call of one RPC, for those that have no method above. If `repeatable`, repeats it as
  // `options.retry` says.
  template <typename Request, typename Response>
  absl::StatusOr<Response> Call(grpc::Status (v1::PolicyAdmin::Stub::*method)(grpc::ClientContext*,
                                                                              const Request&,
                                                                              Response*),
                                const Request& request, bool repeatable) {
    Response response;
    const absl::Status status = client_->CallOther(
        kAdminTimeout, repeatable,
        [&](const std::shared_ptr<grpc::Channel>& channel, grpc::ClientContext* context) {
          return ((*v1::PolicyAdmin::NewStub(channel)).*method)(context, request, &response);
        });
    if (!status.ok()) return status;
    return response;
  }

 private:
  explicit AdminClient(std::unique_ptr<Client> client);

  const std::unique_ptr<Client> client_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_ADMIN_CLIENT_H_
