#include "spikeserve/client.h"

#include <grpcpp/client_context.h>

#include <utility>

#include "absl/memory/memory.h"
#include "absl/strings/str_cat.h"
#include "spikeserve/status.h"

namespace spikeserve {

absl::Status ClientOptions::Validate() const {
  if (call_timeout <= absl::ZeroDuration()) {
    return absl::InvalidArgumentError(absl::StrCat("call_timeout: expected more than 0, received ",
                                                   absl::FormatDuration(call_timeout)));
  }
  return retry.Validate();
}

absl::StatusOr<std::unique_ptr<Client>> Client::Create(const std::string& server,
                                                       ClientOptions options) {
  auto channel = MakeChannel(server, options.security);
  if (!channel.ok()) return channel.status();
  return Create(*std::move(channel), std::move(options));
}

absl::StatusOr<std::unique_ptr<Client>> Client::Create(std::shared_ptr<grpc::Channel> channel,
                                                       ClientOptions options) {
  if (absl::Status status = options.Validate(); !status.ok()) return status;
  return absl::WrapUnique(new Client(std::move(channel), std::move(options)));
}

absl::StatusOr<std::unique_ptr<Client>> Client::Connect(const std::string& server,
                                                        ClientOptions options,
                                                        absl::Duration patience) {
  auto client = Create(server, std::move(options));
  if (!client.ok()) return client.status();
  const auto deadline = absl::ToChronoTime(absl::Now() + patience);
  if (!(*client)->channel_->WaitForConnected(deadline)) {
    return absl::UnavailableError(absl::StrCat("no server could be reached at ", server, " within ",
                                               absl::FormatDuration(patience)));
  }
  return client;
}

Client::Client(std::shared_ptr<grpc::Channel> channel, ClientOptions options)
    : channel_(std::move(channel)),
      stub_(v1::PolicyService::NewStub(channel_)),
      options_(std::move(options)) {}

template <typename Request, typename Response>
absl::Status Client::CallOnce(grpc::Status (v1::PolicyService::Stub::*method)(grpc::ClientContext*,
                                                                              const Request&,
                                                                              Response*),
                              const Request& request, Response* response) {
  grpc::ClientContext context;
  context.set_deadline(absl::ToChronoTime(absl::Now() + options_.call_timeout));
  return StatusFromGrpc(((*stub_).*method)(&context, request, response));
}

template <typename Request, typename Response>
absl::StatusOr<Response> Client::Call(grpc::Status (v1::PolicyService::Stub::*method)(
                                          grpc::ClientContext*, const Request&, Response*),
                                      const Request& request, const std::string& key) {
  Response response;
  const absl::Status status =
      CallWithRetries(options_.retry, key, [&] { return CallOnce(method, request, &response); });
  if (!status.ok()) return status;
  return response;
}

absl::StatusOr<v1::ListPoliciesResponse> Client::ListPolicies() {
  return Call(&v1::PolicyService::Stub::ListPolicies, v1::ListPoliciesRequest(), "ListPolicies");
}

absl::StatusOr<v1::OpenSessionResponse> Client::OpenSession(const v1::OpenSessionRequest& request) {
  return Call(&v1::PolicyService::Stub::OpenSession, request, request.policy());
}

absl::StatusOr<v1::ActResponse> Client::Act(const v1::ActRequest& request) {
  return Call(&v1::PolicyService::Stub::Act, request, request.session_id());
}

void Client::ActAsync(const v1::ActRequest& request,
                      std::function<void(absl::StatusOr<v1::ActResponse>)> done) {
  struct PendingCall {
    grpc::ClientContext context;
    v1::ActRequest request;
    v1::ActResponse response;
  };
  auto call = std::make_shared<PendingCall>();
  call->context.set_deadline(absl::ToChronoTime(absl::Now() + options_.call_timeout));
  call->request = request;
  auto* pending = call.get();
  stub_->async()->Act(
      &pending->context, &pending->request, &pending->response,
      [call = std::move(call), done = std::move(done)](const grpc::Status& status) mutable {
        absl::StatusOr<v1::ActResponse> response = std::move(call->response);
        if (!status.ok()) response = StatusFromGrpc(status);
        // Releases the context, which holds a reference to the channel, before calling `done`.
        // After `done` the client may be destroyed, and a channel must not be destroyed on a thread
        // of gRPC.
        call.reset();
        done(std::move(response));
      });
}

absl::StatusOr<std::vector<absl::StatusOr<v1::ActResponse>>> Client::ActBatch(
    absl::Span<const v1::ActRequest> requests) {
  v1::ActBatchRequest batch;
  batch.mutable_requests()->Add(requests.begin(), requests.end());
  absl::StatusOr<v1::ActBatchResponse> answer =
      Call(&v1::PolicyService::Stub::ActBatch, batch,
           requests.empty() ? std::string() : requests.front().session_id());
  if (!answer.ok()) return answer.status();
  if (answer->results_size() != batch.requests_size()) {
    return absl::InternalError(absl::StrCat("results: expected ", batch.requests_size(),
                                            " of them, received ", answer->results_size()));
  }
  std::vector<absl::StatusOr<v1::ActResponse>> results;
  results.reserve(requests.size());
  for (v1::ActResult& result : *answer->mutable_results()) {
    if (result.code() == 0) {
      results.emplace_back(std::move(*result.mutable_response()));
    } else {
      results.emplace_back(StatusFromCode(result.code(), result.message()));
    }
  }
  return results;
}

std::unique_ptr<RemoteStream> Client::OpenStream() {
  return std::make_unique<RemoteStream>(*stub_);
}

absl::StatusOr<v1::EndEpisodeResponse> Client::EndEpisode(const v1::EndEpisodeRequest& request) {
  return Call(&v1::PolicyService::Stub::EndEpisode, request, request.session_id());
}

absl::StatusOr<v1::GetSessionResponse> Client::GetSession(const std::string& session_id,
                                                          bool include_head_delta) {
  v1::GetSessionRequest request;
  request.set_session_id(session_id);
  request.set_include_head_delta(include_head_delta);
  return Call(&v1::PolicyService::Stub::GetSession, request, session_id);
}

absl::StatusOr<v1::ExplainResponse> Client::Explain(const std::string& session_id) {
  v1::ExplainRequest request;
  request.set_session_id(session_id);
  return Call(&v1::PolicyService::Stub::Explain, request, session_id);
}

absl::Status Client::CloseSession(const std::string& session_id) {
  v1::CloseSessionRequest request;
  request.set_session_id(session_id);
  v1::CloseSessionResponse response;
  int attempts = 0;
  const absl::Status status = CallWithRetries(options_.retry, session_id, [&] {
    ++attempts;
    return CallOnce(&v1::PolicyService::Stub::CloseSession, request, &response);
  });
  const bool closed_by_lost_attempt = attempts > 1 && absl::IsNotFound(status);
  return closed_by_lost_attempt ? absl::OkStatus() : status;
}

}  // namespace spikeserve
