#include "spikeserve/client.h"

#include <grpcpp/client_context.h>

#include <optional>
#include <utility>

#include "absl/memory/memory.h"
#include "absl/strings/str_cat.h"
#include "client/src/diagnosis.h"
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
  if ((*client)->channel_->WaitForConnected(deadline)) return client;
  // The status of a call has gRPC's own words for the cause.
  v1::ListPoliciesResponse ignored;
  const absl::Status status = (*client)->CallOnce(&v1::PolicyService::Stub::ListPolicies,
                                                  v1::ListPoliciesRequest(), &ignored);
  const std::string cause =
      DiagnoseConnection(server, (*client)->options_.security.use_tls(), status.message());
  return absl::UnavailableError(absl::StrCat("no server could be reached at ", server, " within ",
                                             absl::FormatDuration(patience),
                                             cause.empty() ? "" : ": ", cause));
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

template <typename Request, typename Response>
absl::StatusOr<Response> Client::CallOfSession(grpc::Status (v1::PolicyService::Stub::*method)(
                                                   grpc::ClientContext*, const Request&, Response*),
                                               const Request& request) {
  auto response = Call(method, request, request.session_id());
  if (!response.ok()) return ForSession(response.status());
  return response;
}

absl::StatusOr<v1::ListPoliciesResponse> Client::ListPolicies() {
  return Call(&v1::PolicyService::Stub::ListPolicies, v1::ListPoliciesRequest(), "ListPolicies");
}

absl::StatusOr<v1::OpenSessionResponse> Client::OpenSession(const v1::OpenSessionRequest& request) {
  return Call(&v1::PolicyService::Stub::OpenSession, request, request.policy());
}

absl::StatusOr<v1::ActResponse> Client::Act(const v1::ActRequest& request) {
  return CallOfSession(&v1::PolicyService::Stub::Act, request);
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
        if (!status.ok()) response = ForSession(StatusFromGrpc(status));
        // Releases the context, which holds a reference to the channel, before calling `done`.
        // After `done` the client may be destroyed, and a channel must not be destroyed on a thread
        // of gRPC.
        call.reset();
        done(std::move(response));
      });
}

// Makes one decision for each of `requests` with one call.
absl::StatusOr<std::vector<absl::StatusOr<v1::ActResponse>>> Client::ActBatchOnce(
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
      continue;
    }
    std::optional<double> delay;
    if (result.has_retry_after_seconds()) delay = result.retry_after_seconds();
    results.emplace_back(ForSession(StatusFromCode(result.code(), result.message(), delay)));
  }
  return results;
}

absl::StatusOr<std::vector<absl::StatusOr<v1::ActResponse>>> Client::ActBatch(
    absl::Span<const v1::ActRequest> requests) {
  auto results = ActBatchOnce(requests);
  RetrySchedule schedule(options_.retry, requests.empty() ? "" : requests.front().session_id());
  while (results.ok()) {
    std::vector<size_t> refused;
    std::vector<v1::ActRequest> again;
    absl::Status longest;  // of the refused items, the one that has to wait longest
    for (size_t i = 0; i < results->size(); ++i) {
      const absl::Status& status = (*results)[i].status();
      if (!IsRefusedForNow(status)) continue;
      refused.push_back(i);
      again.push_back(requests[i]);
      if (longest.ok() || RetryAfter(status) > RetryAfter(longest)) longest = status;
    }
    if (refused.empty()) break;
    const auto delay = schedule.DelayAfter(longest);
    if (!delay.has_value()) break;
    options_.retry.sleep(*delay);
    auto part = ActBatchOnce(again);
    if (!part.ok()) return part.status();
    for (size_t i = 0; i < refused.size(); ++i) (*results)[refused[i]] = std::move((*part)[i]);
  }
  return results;
}

std::unique_ptr<RemoteStream> Client::OpenStream() {
  return std::make_unique<RemoteStream>(*stub_);
}

absl::StatusOr<v1::EndEpisodeResponse> Client::EndEpisode(const v1::EndEpisodeRequest& request) {
  return CallOfSession(&v1::PolicyService::Stub::EndEpisode, request);
}

absl::StatusOr<v1::GetSessionResponse> Client::GetSession(const std::string& session_id,
                                                          bool include_head_delta) {
  v1::GetSessionRequest request;
  request.set_session_id(session_id);
  request.set_include_head_delta(include_head_delta);
  return CallOfSession(&v1::PolicyService::Stub::GetSession, request);
}

absl::StatusOr<v1::ExplainResponse> Client::Explain(const std::string& session_id) {
  v1::ExplainRequest request;
  request.set_session_id(session_id);
  return CallOfSession(&v1::PolicyService::Stub::Explain, request);
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
