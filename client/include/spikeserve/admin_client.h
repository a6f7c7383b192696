// Calls the methods of PolicyAdmin, which operators use. policy_admin.proto describes them.
//
//   auto admin = AdminClient::Connect("127.0.0.1:50051");
//   v1::SetDefaultVersionRequest request;
//   request.set_policy("cartpole");
//   auto response = (*admin)->Call(&v1::PolicyAdmin::Stub::SetDefaultVersion, request);
//
// With several servers (Client), a call goes to any of them that answers.
//
// Thread-safe.
#ifndef SPIKESERVE_ADMIN_CLIENT_H_
#define SPIKESERVE_ADMIN_CLIENT_H_

#include <grpcpp/client_context.h>

#include <memory>
#include <string>
#include <utility>

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
  // As Client::Connect. `options.call_timeout` is ignored.
  static absl::StatusOr<std::unique_ptr<AdminClient>> Connect(
      const std::string& servers, ClientOptions options = {},
      absl::Duration patience = absl::Seconds(3));

  // Makes the call of one RPC. Returns the server's code and message on an error.
  //
  // Methods that policy_admin.proto declares as free of side effects or idempotent are repeated as
  // `options.retry` says, and the others only if the server refused them for now. Each attempt may
  // take `timeout`.
  template <typename Request, typename Response>
  absl::StatusOr<Response> Call(grpc::Status (v1::PolicyAdmin::Stub::*method)(grpc::ClientContext*,
                                                                              const Request&,
                                                                              Response*),
                                const Request& request, absl::Duration timeout = kAdminTimeout) {
    Response response;
    const absl::Status status = client_->CallOther(
        timeout, IsRepeatable(*Request::descriptor()),
        [&](const std::shared_ptr<grpc::Channel>& channel, grpc::ClientContext* context) {
          return ((*v1::PolicyAdmin::NewStub(channel)).*method)(context, request, &response);
        });
    if (!status.ok()) return status;
    return response;
  }

  // Sends the file of a version. `request` has everything but `data`.
  absl::StatusOr<v1::PushPolicyResponse> Push(v1::PushPolicyRequest request,
                                              const std::string& file);

 private:
  explicit AdminClient(std::unique_ptr<Client> client) : client_(std::move(client)) {}

  // Returns what the wire contract says about the method whose requests are of this type.
  static bool IsRepeatable(const google::protobuf::Descriptor& request);

  const std::unique_ptr<Client> client_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_ADMIN_CLIENT_H_
