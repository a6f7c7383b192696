// Calls the methods of PolicyService. Every attempt has a deadline, and calls that may safely be
// repeated are retried.
//
//   auto client = Client::Connect("127.0.0.1:50051");
//   auto opened = (*client)->OpenSession(request);
//   auto answer = (*client)->Act(act_request);
//
// For one session, RemoteSession (remote_session.h) is simpler: it keeps count of the steps.
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
  absl::Duration call_timeout = absl::Seconds(5);  // the deadline of one attempt
  RetryOptions retry;
  SecurityOptions security;

  // Returns INVALID_ARGUMENT that names the field, the expected and the received value.
  absl::Status Validate() const;
};

class Client {
 public:
  // Creates a client of the server at "HOST:PORT" on a new channel (MakeChannel), or on `channel`.
  // Does not wait for the connection. Returns INVALID_ARGUMENT if `options` are not valid, and the
  // errors of MakeChannel.
  static absl::StatusOr<std::unique_ptr<Client>> Create(const std::string& server,
                                                        ClientOptions options = {});
  static absl::StatusOr<std::unique_ptr<Client>> Create(std::shared_ptr<grpc::Channel> channel,
                                                        ClientOptions options = {});

  // As Create, but waits for the connection. Returns UNAVAILABLE, with the cause, if there is none
  // within `patience`.
  static absl::StatusOr<std::unique_ptr<Client>> Connect(
      const std::string& server, ClientOptions options = {},
      absl::Duration patience = absl::Seconds(3));

  // The channel of this client, for calls of other services.
  const std::shared_ptr<grpc::Channel>& channel() const { return channel_; }

  // The methods below return the server's code and message on an error. After the last attempt they
  // return UNAVAILABLE if the server could not be reached, and DEADLINE_EXCEEDED if it did not
  // answer within call_timeout. RetryAfter and IsSessionLost (status.h) say more about an error.

  absl::StatusOr<v1::ListPoliciesResponse> ListPolicies();

  // Retried. If an answer is lost, the session that it opened stays idle until the server ends it.
  absl::StatusOr<v1::OpenSessionResponse> OpenSession(const v1::OpenSessionRequest& request);

  // Retried: the server answers a repeated step with the stored answer, byte for byte.
  absl::StatusOr<v1::ActResponse> Act(const v1::ActRequest& request);

  // Makes one attempt without blocking. Calls `done` once, on a thread of gRPC; `done` must not
  // block. The client must outlive the call.
  void ActAsync(const v1::ActRequest& request,
                std::function<void(absl::StatusOr<v1::ActResponse>)> done);

  // Makes one decision for each request and returns the results in the same order. The call is
  // retried as a whole, and its items that the server refused for now are sent again. An item that
  // failed has its own status, and may be sent again with the same step.
  absl::StatusOr<std::vector<absl::StatusOr<v1::ActResponse>>> ActBatch(
      absl::Span<const v1::ActRequest> requests);

  // Opens a stream for any number of sessions.
  std::unique_ptr<RemoteStream> OpenStream();

  // Retried: the server recognises a repeated request and counts the end of an episode once.
  absl::StatusOr<v1::EndEpisodeResponse> EndEpisode(const v1::EndEpisodeRequest& request);

  // Retried. With `include_head_delta`, the response holds W - W_base of the session's action head.
  absl::StatusOr<v1::GetSessionResponse> GetSession(const std::string& session_id,
                                                    bool include_head_delta = false);

  // Retried.
  absl::StatusOr<v1::ExplainResponse> Explain(const std::string& session_id);

  // Retried. Returns OK if a repeated attempt finds that the session does not exist any more.
  absl::Status CloseSession(const std::string& session_id);

 private:
  Client(std::shared_ptr<grpc::Channel> channel, ClientOptions options);

  // Makes one attempt of the stub's `method`.
  template <typename Request, typename Response>
  absl::Status CallOnce(grpc::Status (v1::PolicyService::Stub::*method)(grpc::ClientContext*,
                                                                        const Request&, Response*),
                        const Request& request, Response* response);

  template <typename Request, typename Response>
  absl::StatusOr<Response> Call(grpc::Status (v1::PolicyService::Stub::*method)(
                                    grpc::ClientContext*, const Request&, Response*),
                                const Request& request, const std::string& key);

  // As Call, for a request that names a session.
  template <typename Request, typename Response>
  absl::StatusOr<Response> CallOfSession(grpc::Status (v1::PolicyService::Stub::*method)(
                                             grpc::ClientContext*, const Request&, Response*),
                                         const Request& request);

  absl::StatusOr<std::vector<absl::StatusOr<v1::ActResponse>>> ActBatchOnce(
      absl::Span<const v1::ActRequest> requests);

  const std::shared_ptr<grpc::Channel> channel_;
  const std::unique_ptr<v1::PolicyService::Stub> stub_;
  const ClientOptions options_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_CLIENT_H_
