// The calls of PolicyService, one method each: a deadline for every attempt, and retries where a
// repeated call is harmless. An agent with one session wants RemoteSession (remote_session.h),
// which keeps its step.
//
// Thread-safe.
#ifndef SPIKESERVE_CLIENT_H_
#define SPIKESERVE_CLIENT_H_

#include <grpcpp/channel.h>

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "spikeserve/channel.h"
#include "spikeserve/remote_stream.h"
#include "spikeserve/retry.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {

struct ClientOptions {
  absl::Duration call_timeout = absl::Seconds(5);  // of each attempt
  RetryOptions retry;
  SecurityOptions security;

  // INVALID_ARGUMENT names the field, what was expected and what came.
  absl::Status Validate() const;
};

class Client {
 public:
  // A client of the server at "HOST:PORT" on a connection of its own, as MakeChannel makes it.
  // INVALID_ARGUMENT if `options` are not valid.
  static absl::StatusOr<std::unique_ptr<Client>> Create(const std::string& server,
                                                        ClientOptions options = {});
  static absl::StatusOr<std::unique_ptr<Client>> Create(std::shared_ptr<grpc::Channel> channel,
                                                        ClientOptions options = {});

  // Create, and wait for the connection. UNAVAILABLE if there is none within `patience`.
  static absl::StatusOr<std::unique_ptr<Client>> Connect(
      const std::string& server, ClientOptions options = {},
      absl::Duration patience = absl::Seconds(3));

  // For services beside PolicyService.
  const std::shared_ptr<grpc::Channel>& channel() const { return channel_; }

  // Errors of every call: the server's code and message; after the last attempt UNAVAILABLE if the
  // server could not be reached, DEADLINE_EXCEEDED if it did not answer in call_timeout.

  absl::StatusOr<v1::ListPoliciesResponse> ListPolicies();

  // Retried: a session whose id was lost on the way is reaped by the server.
  absl::StatusOr<v1::OpenSessionResponse> OpenSession(const v1::OpenSessionRequest& request);

  // Retried: the server answers a repeated step with the stored answer, byte for byte.
  absl::StatusOr<v1::ActResponse> Act(const v1::ActRequest& request);

  // One attempt that does not block; `done` is called once, on a thread of gRPC's, and must not
  // block. The client must outlive the call.
  void ActAsync(const v1::ActRequest& request,
                std::function<void(absl::StatusOr<v1::ActResponse>)> done);

  // One decision for each request, in their order. The call is retried as a whole; an item that
  // failed has its own status here and may be sent again with the same step.
  absl::StatusOr<std::vector<absl::StatusOr<v1::ActResponse>>> ActBatch(
      absl::Span<const v1::ActRequest> requests);

  // A stream for any number of sessions.
  std::unique_ptr<RemoteStream> OpenStream();

  // Retried; the server recognises the end that it has counted.
  absl::StatusOr<v1::EndEpisodeResponse> EndEpisode(const v1::EndEpisodeRequest& request);

  // Retried. `include_head_delta` asks for W - W_base of the head it plays on.
  absl::StatusOr<v1::GetSessionResponse> GetSession(const std::string& session_id,
                                                    bool include_head_delta = false);

  // Retried.
  absl::StatusOr<v1::ExplainResponse> Explain(const std::string& session_id);

  // Retried; OK if a repeated attempt finds the session gone.
  absl::Status CloseSession(const std::string& session_id);

 private:
  Client(std::shared_ptr<grpc::Channel> channel, ClientOptions options);

  // One attempt of the stub's `method`.
  template <typename Request, typename Response>
  absl::Status CallOnce(grpc::Status (v1::PolicyService::Stub::*method)(grpc::ClientContext*,
                                                                        const Request&, Response*),
                        const Request& request, Response* response);

  template <typename Request, typename Response>
  absl::StatusOr<Response> Call(grpc::Status (v1::PolicyService::Stub::*method)(
                                    grpc::ClientContext*, const Request&, Response*),
                                const Request& request, const std::string& key);

  const std::shared_ptr<grpc::Channel> channel_;
  const std::unique_ptr<v1::PolicyService::Stub> stub_;
  const ClientOptions options_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_CLIENT_H_
