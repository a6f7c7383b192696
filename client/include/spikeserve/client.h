// Calls the methods of PolicyService. Every attempt has a deadline, and calls that may safely be
// repeated are retried.
//
//   auto client = Client::Connect("127.0.0.1:50051");
//   auto opened = (*client)->OpenSession(request);
//   auto answer = (*client)->Act(act_request);
//
// For one session, RemoteSession (remote_session.h) is simpler: it keeps count of the steps.
//
// Several addresses, separated by commas, are those of servers that share their sessions in one
// store (docs/guides/fleet.md). Each session prefers one of them, the same one in all clients, and
// its calls go to another one while that one does not answer.
//
// Thread-safe.
#ifndef SPIKESERVE_CLIENT_H_
#define SPIKESERVE_CLIENT_H_

#include <grpcpp/channel.h>

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/functional/function_ref.h"
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

// Names calls that go to one server together: those of a session, of a stream, or of all sessions
// of a batch. Sessions without a store exist at one server only, so open them with the route of the
// stream or batch that they are played on. With one server, routes have no effect but the metadata
// `spikeserve-affinity`, by which a proxy may choose a server.
struct Route;
std::shared_ptr<Route> MakeRoute();

class Attempts;
class Replicas;
namespace piloting {
class BackgroundThread;
}
struct Line;
struct Replica;

class Client {
 public:
  // Creates a client of the server at "HOST:PORT" or "unix:PATH", or of several of them, separated
  // by commas, on new channels (MakeChannel), or of one server on `channel`. Does not wait for a
  // connection. Returns INVALID_ARGUMENT if `servers` or `options` are not valid, and the errors of
  // MakeChannel.
  static absl::StatusOr<std::unique_ptr<Client>> Create(const std::string& servers,
                                                        ClientOptions options = {});
  static absl::StatusOr<std::unique_ptr<Client>> Create(std::shared_ptr<grpc::Channel> channel,
                                                        ClientOptions options = {});

  // As Create, but waits until one server is connected. Returns UNAVAILABLE, with the causes, if
  // none is within `patience`.
  static absl::StatusOr<std::unique_ptr<Client>> Connect(
      const std::string& servers, ClientOptions options = {},
      absl::Duration patience = absl::Seconds(3));

  // Blocks until health checks of servers, which run in the background, have ended.
  ~Client();

  const ClientOptions& options() const { return options_; }

  // Calls another service: makes attempts with `attempt` on the channel of a server that is not
  // away, with a deadline of `timeout` each. After an error, repeats the call as `options().retry`
  // says, at another server if there is one. If not `repeatable`, repeats it only if the server
  // refused it for now. Returns the last status.
  absl::Status CallOther(
      absl::Duration timeout, bool repeatable,
      absl::FunctionRef<grpc::Status(const std::shared_ptr<grpc::Channel>&, grpc::ClientContext*)>
          attempt);

  // The methods below return the server's code and message on an error. After the last attempt they
  // return UNAVAILABLE if the server could not be reached, and DEADLINE_EXCEEDED if it did not
  // answer within call_timeout. RetryAfter, IsSessionLost and ExpectedDecision (status.h) say more
  // about an error. Without a `route`, a call takes the one of its session.

  absl::StatusOr<v1::ListPoliciesResponse> ListPolicies();

  // Retried. Draws the id of the session if the request has none, so that a repeated attempt finds
  // the session that an earlier one has opened.
  absl::StatusOr<v1::OpenSessionResponse> OpenSession(
      const v1::OpenSessionRequest& request, const std::shared_ptr<Route>& route = nullptr);

  // Retried: the server answers a repeated step with the stored answer, byte for byte.
  absl::StatusOr<v1::ActResponse> Act(const v1::ActRequest& request,
                                      const std::shared_ptr<Route>& route = nullptr);

  // Makes one attempt without blocking. Calls `done` once, on a thread of gRPC; `done` must not
  // block. The client must outlive the call.
  void ActAsync(const v1::ActRequest& request,
                std::function<void(absl::StatusOr<v1::ActResponse>)> done,
                const std::shared_ptr<Route>& route = nullptr);

  // Makes one decision for each request and returns the results in the same order. The call is
  // retried as a whole, and its items that the server could not answer now are sent again. An item
  // that failed has its own status, and may be sent again with the same step. Without a `route`,
  // there is one call for each server that some of the sessions prefer.
  absl::StatusOr<std::vector<absl::StatusOr<v1::ActResponse>>> ActBatch(
      absl::Span<const v1::ActRequest> requests, const std::shared_ptr<Route>& route = nullptr);

  // Opens a stream for any number of sessions, on a route of its own if there is no `route`.
  std::unique_ptr<RemoteStream> OpenStream(std::shared_ptr<Route> route = nullptr);

  // Retried: the server recognises a repeated request and counts the end of an episode once.
  absl::StatusOr<v1::EndEpisodeResponse> EndEpisode(const v1::EndEpisodeRequest& request,
                                                    const std::shared_ptr<Route>& route = nullptr);

  // Retried. With `include_head_delta`, the response holds W - W_base of the session's action head.
  absl::StatusOr<v1::GetSessionResponse> GetSession(const std::string& session_id,
                                                    bool include_head_delta = false,
                                                    const std::shared_ptr<Route>& route = nullptr);

  // Retried.
  absl::StatusOr<v1::ExplainResponse> Explain(const std::string& session_id,
                                              const std::shared_ptr<Route>& route = nullptr);

  // Retried. Returns the value of the session, from which an engine on the robot continues it; with
  // `include_policy`, also the policy's file.
  absl::StatusOr<v1::ExportSessionResponse> ExportSession(
      const std::string& session_id, bool include_policy = false,
      const std::shared_ptr<Route>& route = nullptr);

  // Retried. Returns OK if a repeated attempt finds that the session does not exist any more.
  absl::Status CloseSession(const std::string& session_id,
                            const std::shared_ptr<Route>& route = nullptr);

 private:
  friend class Pilot;
  friend class RemoteSession;
  friend class RemoteStream;

  // How a call is repeated.
  struct Rules {
    absl::Duration timeout;          // of each attempt
    bool repeatable = true;          // also if it may have been carried out
    bool not_found_is_done = false;  // NOT_FOUND after a failed attempt counts as OK
    bool names_session = false;      // which another server may have
    uint64_t decision = 0;           // of the request; 0: it has none
  };
  using BatchResults = std::vector<absl::StatusOr<v1::ActResponse>>;

  Client(std::unique_ptr<Replicas> replicas, ClientOptions options);

  // Makes attempts of one call until one succeeds or `rules` and `attempts` allow no other one.
  absl::Status Run(const Rules& rules, Attempts& attempts,
                   absl::FunctionRef<grpc::Status(Line&, grpc::ClientContext*)> attempt);

  // Calls the stub's `method` for a request that names a session.
  template <typename Request, typename Response>
  absl::StatusOr<Response> CallOfSession(grpc::Status (v1::PolicyService::Stub::*method)(
                                             grpc::ClientContext*, const Request&, Response*),
                                         const Request& request,
                                         const std::shared_ptr<Route>& route);

  absl::StatusOr<BatchResults> ActBatchOnce(absl::Span<const v1::ActRequest> requests,
                                            Attempts& attempts);
  // Makes the decisions of `requests` at the server of `route`.
  absl::StatusOr<BatchResults> ActBatchOn(absl::Span<const v1::ActRequest> requests, Route& route);

  const std::unique_ptr<Replicas> replicas_;
  const ClientOptions options_;
  const std::unique_ptr<piloting::BackgroundThread> background_;  // the background thread of pilots
};

}  // namespace spikeserve

#endif  // SPIKESERVE_CLIENT_H_
