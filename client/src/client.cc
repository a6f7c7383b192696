#include "spikeserve/client.h"

#include <grpcpp/client_context.h>

#include <algorithm>
#include <map>
#include <optional>
#include <utility>

#include "absl/memory/memory.h"
#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "client/src/attempts.h"
#include "client/src/diagnosis.h"
#include "client/src/item_status.h"
#include "client/src/pilot/background_thread.h"
#include "client/src/replicas.h"
#include "client/src/steady_time.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

using Stub = v1::PolicyService::Stub;

// The route of a call: `given`, or one for `key` that exists for this call alone.
class RouteOfCall {
 public:
  RouteOfCall(const std::shared_ptr<Route>& given, const std::string& key) : given_(given.get()) {
    if (given_ == nullptr) own_.emplace(key);
  }

  Route& get() { return given_ == nullptr ? *own_ : *given_; }

 private:
  Route* const given_;
  std::optional<Route> own_;
};

void Prepare(const Route& route, absl::Duration timeout, grpc::ClientContext* context) {
  context->set_deadline(absl::ToChronoTime(absl::Now() + timeout));
  // The id of a session that does not exist may be any text, but gRPC aborts on illegal metadata.
  const bool is_legal = std::all_of(route.key.begin(), route.key.end(), absl::ascii_isprint);
  if (is_legal && !route.key.empty()) context->AddMetadata(kAffinityKey, route.key);
}

std::unique_ptr<Replicas> MakeReplicas(std::vector<std::unique_ptr<Replica>> replicas,
                                       const RetryOptions& retry) {
  return std::make_unique<Replicas>(std::move(replicas), retry.initial_backoff, retry.max_backoff);
}

}  // namespace

std::shared_ptr<Route> MakeRoute() { return std::make_shared<Route>(DrawId()); }

absl::Status ClientOptions::Validate() const {
  const std::pair<const char*, absl::Duration> times[] = {
      {"call_timeout", call_timeout},
      {"keepalive", security.keepalive},
      {"keepalive_timeout", security.keepalive_timeout}};
  for (const auto& [field, time] : times) {
    if (time > absl::ZeroDuration()) continue;
    return absl::InvalidArgumentError(
        absl::StrCat(field, ": expected more than 0, received ", absl::FormatDuration(time)));
  }
  return retry.Validate();
}

absl::StatusOr<std::unique_ptr<Client>> Client::Create(const std::string& servers,
                                                       ClientOptions options) {
  if (absl::Status status = options.Validate(); !status.ok()) return status;
  const auto addresses = ParseServers(servers);
  if (!addresses.ok()) return addresses.status();
  std::vector<std::unique_ptr<Replica>> replicas;
  for (const std::string& address : *addresses) {
    auto channel = MakeChannel(address, options.security);
    if (!channel.ok()) return channel.status();
    // The credentials were read from files that may be new ones by now.
    Connector connect = [address, security = options.security] {
      auto fresh = MakeChannel(address, security);
      return fresh.ok() ? *std::move(fresh) : nullptr;
    };
    replicas.push_back(std::make_unique<Replica>(address, *std::move(channel), std::move(connect)));
  }
  auto all = MakeReplicas(std::move(replicas), options.retry);
  return absl::WrapUnique(new Client(std::move(all), std::move(options)));
}

absl::StatusOr<std::unique_ptr<Client>> Client::Create(std::shared_ptr<grpc::Channel> channel,
                                                       ClientOptions options) {
  if (absl::Status status = options.Validate(); !status.ok()) return status;
  std::vector<std::unique_ptr<Replica>> replicas;
  replicas.push_back(std::make_unique<Replica>("", std::move(channel), nullptr));
  auto all = MakeReplicas(std::move(replicas), options.retry);
  return absl::WrapUnique(new Client(std::move(all), std::move(options)));
}

absl::StatusOr<std::unique_ptr<Client>> Client::Connect(const std::string& servers,
                                                        ClientOptions options,
                                                        absl::Duration patience) {
  auto client = Create(servers, std::move(options));
  if (!client.ok()) return client.status();
  Replicas& replicas = *(*client)->replicas_;
  if (replicas.AwaitConnection(patience)) return client;
  std::string causes;
  replicas.ForEach([&](Replica& replica) {
    // The status of a call has gRPC's own words for the cause.
    grpc::ClientContext context;
    Prepare(Route(""), (*client)->options_.call_timeout, &context);
    v1::ListPoliciesResponse ignored;
    const grpc::Status status =
        replica.connection.line()->stub->ListPolicies(&context, {}, &ignored);
    const std::string cause = DiagnoseConnection(
        replica.address, (*client)->options_.security.use_tls(), status.error_message());
    if (cause.empty()) return;
    const std::string which = replicas.size() == 1 ? "" : absl::StrCat(replica.address, ": ");
    absl::StrAppend(&causes, causes.empty() ? ": " : "; ", which, cause);
  });
  return absl::UnavailableError(absl::StrCat("no server could be reached at ", servers, " within ",
                                             absl::FormatDuration(patience), causes));
}

Client::Client(std::unique_ptr<Replicas> replicas, ClientOptions options)
    : replicas_(std::move(replicas)),
      options_(std::move(options)),
      background_(std::make_unique<piloting::BackgroundThread>()) {}

Client::~Client() = default;

absl::Status Client::Run(const Rules& rules, Attempts& attempts,
                         absl::FunctionRef<grpc::Status(Line&, grpc::ClientContext*)> attempt) {
  for (bool is_first = true;; is_first = false) {
    grpc::ClientContext context;
    Prepare(attempts.route(), rules.timeout, &context);
    const RenewableConnection::Watched watched(&attempts.replica().connection, &context,
                                               /*expects_answer=*/true);
    const absl::Status status = watched.Note(StatusFromGrpc(attempt(watched.line(), &context)));
    if (status.ok()) {
      attempts.Answered();
      return status;
    }
    if (rules.not_found_is_done && !is_first && absl::IsNotFound(status)) return absl::OkStatus();
    const bool is_elsewhere = rules.names_session && IsElsewhere(status, rules.decision);
    const auto delay = attempts.DelayAfter(status, rules.timeout, is_elsewhere);
    if (!delay.has_value() || !(rules.repeatable || IsRefusedForNow(status))) return status;
    options_.retry.sleep(*delay);
  }
}

absl::Status Client::CallOther(
    absl::Duration timeout, bool repeatable,
    absl::FunctionRef<grpc::Status(const std::shared_ptr<grpc::Channel>&, grpc::ClientContext*)>
        attempt) {
  Route route("");
  Attempts attempts(replicas_.get(), &route, options_.retry);
  return Run(
      {.timeout = timeout, .repeatable = repeatable}, attempts,
      [&](Line& line, grpc::ClientContext* context) { return attempt(line.channel, context); });
}

template <typename Request, typename Response>
absl::StatusOr<Response> Client::CallOfSession(
    grpc::Status (Stub::*method)(grpc::ClientContext*, const Request&, Response*),
    const Request& request, const std::shared_ptr<Route>& route) {
  RouteOfCall route_of_call(route, request.session_id());
  Attempts attempts(replicas_.get(), &route_of_call.get(), options_.retry);
  Rules rules = {.timeout = options_.call_timeout, .names_session = true};
  if constexpr (requires { request.decision(); }) rules.decision = request.decision();
  Response response;
  const absl::Status status = Run(rules, attempts, [&](Line& line, grpc::ClientContext* context) {
    return ((*line.stub).*method)(context, request, &response);
  });
  if (!status.ok()) return ForSession(status);
  return response;
}

absl::StatusOr<v1::ListPoliciesResponse> Client::ListPolicies() {
  v1::ListPoliciesResponse response;
  const absl::Status status =
      CallOther(options_.call_timeout, /*repeatable=*/true,
                [&](const std::shared_ptr<grpc::Channel>& channel, grpc::ClientContext* context) {
                  return v1::PolicyService::NewStub(channel)->ListPolicies(context, {}, &response);
                });
  if (!status.ok()) return status;
  return response;
}

absl::StatusOr<v1::OpenSessionResponse> Client::OpenSession(const v1::OpenSessionRequest& request,
                                                            const std::shared_ptr<Route>& route) {
  v1::OpenSessionRequest named = request;
  if (named.session_id().empty()) named.set_session_id(DrawId());
  RouteOfCall route_of_call(route, named.session_id());
  // NOT_FOUND is about the policy.
  Attempts attempts(replicas_.get(), &route_of_call.get(), options_.retry);
  v1::OpenSessionResponse response;
  const absl::Status status = Run({.timeout = options_.call_timeout}, attempts,
                                  [&](Line& line, grpc::ClientContext* context) {
                                    return line.stub->OpenSession(context, named, &response);
                                  });
  if (!status.ok()) return status;
  return response;
}

absl::StatusOr<v1::ActResponse> Client::Act(const v1::ActRequest& request,
                                            const std::shared_ptr<Route>& route) {
  return CallOfSession(&Stub::Act, request, route);
}

void Client::ActAsync(const v1::ActRequest& request,
                      std::function<void(absl::StatusOr<v1::ActResponse>)> done,
                      const std::shared_ptr<Route>& route) {
  struct PendingCall {
    std::shared_ptr<Route> route;
    std::shared_ptr<Line> line;
    absl::Duration began = SteadyNow();
    grpc::ClientContext context;
    v1::ActRequest request;
    v1::ActResponse response;
  };
  auto call = std::make_shared<PendingCall>();
  call->route = route == nullptr ? std::make_shared<Route>(request.session_id()) : route;
  Prepare(*call->route, options_.call_timeout, &call->context);
  call->request = request;
  auto* pending = call.get();
  Replica& replica = *replicas_->Choose(*call->route);
  pending->line = replica.connection.line();
  pending->line->stub->async()->Act(&pending->context, &pending->request, &pending->response,
                                    [this, &replica, call = std::move(call),
                                     done = std::move(done)](const grpc::Status& status) mutable {
                                      absl::StatusOr<v1::ActResponse> response =
                                          std::move(call->response);
                                      if (!status.ok())
                                        response = ForSession(StatusFromGrpc(status));
                                      if (status.ok()) {
                                        replica.connection.Answered();
                                        replicas_->Answered(*call->route, replica);
                                      } else if (absl::IsDeadlineExceeded(response.status())) {
                                        replica.connection.Missed(call->began);
                                        replicas_->Failed(replica, options_.call_timeout);
                                      } else if (IsRetryable(response.status())) {
                                        replicas_->Failed(replica);
                                      }
                                      // Releases the context, which holds a reference to the
                                      // channel, before calling `done`. After `done` the client may
                                      // be destroyed, and a channel must not be destroyed on a
                                      // thread of gRPC.
                                      call.reset();
                                      done(std::move(response));
                                    });
}

// Makes one decision for each of `requests` with one call.
absl::StatusOr<Client::BatchResults> Client::ActBatchOnce(absl::Span<const v1::ActRequest> requests,
                                                          Attempts& attempts) {
  v1::ActBatchRequest batch;
  batch.mutable_requests()->Add(requests.begin(), requests.end());
  v1::ActBatchResponse answer;
  const absl::Status status = Run({.timeout = options_.call_timeout, .names_session = true},
                                  attempts, [&](Line& line, grpc::ClientContext* context) {
                                    return line.stub->ActBatch(context, batch, &answer);
                                  });
  if (!status.ok()) return status;
  if (answer.results_size() != batch.requests_size()) {
    return absl::InternalError(absl::StrCat("results: expected ", batch.requests_size(),
                                            " of them, received ", answer.results_size()));
  }
  BatchResults results;
  results.reserve(requests.size());
  for (v1::ActResult& result : *answer.mutable_results()) {
    if (result.code() == 0) {
      results.emplace_back(std::move(*result.mutable_response()));
    } else {
      results.emplace_back(StatusOfItem(result));
    }
  }
  return results;
}

absl::StatusOr<Client::BatchResults> Client::ActBatchOn(absl::Span<const v1::ActRequest> requests,
                                                        Route& route) {
  Attempts attempts(replicas_.get(), &route, options_.retry);
  auto results = ActBatchOnce(requests, attempts);
  size_t last_failed = 0;
  while (results.ok()) {
    const bool may_move = replicas_->MayMove(route);
    std::vector<size_t> failed;
    std::vector<v1::ActRequest> again;
    absl::Status longest;  // of the failed items, the one that has to wait longest
    bool all_elsewhere = true;
    for (size_t i = 0; i < results->size(); ++i) {
      const absl::Status& status = (*results)[i].status();
      const bool is_elsewhere = may_move && IsElsewhere(status, requests[i].decision());
      if (!is_elsewhere && !IsRetryable(status) && !IsRefusedForNow(status)) continue;
      failed.push_back(i);
      again.push_back(requests[i]);
      // A lost session is the error only if nothing else is wrong.
      const bool is_longer =
          is_elsewhere == all_elsewhere ? RetryAfter(status) > RetryAfter(longest) : !is_elsewhere;
      if (longest.ok() || is_longer) longest = status;
      all_elsewhere = all_elsewhere && is_elsewhere;
    }
    if (failed.empty()) break;
    if (failed.size() != last_failed) attempts.PartAnswered();
    last_failed = failed.size();
    const auto delay = attempts.DelayAfter(longest, options_.call_timeout, all_elsewhere);
    if (!delay.has_value()) break;
    options_.retry.sleep(*delay);
    auto part = ActBatchOnce(again, attempts);
    if (!part.ok()) return part.status();
    for (size_t i = 0; i < failed.size(); ++i) (*results)[failed[i]] = std::move((*part)[i]);
  }
  return results;
}

absl::StatusOr<Client::BatchResults> Client::ActBatch(absl::Span<const v1::ActRequest> requests,
                                                      const std::shared_ptr<Route>& route) {
  if (route != nullptr) return ActBatchOn(requests, *route);
  if (replicas_->size() == 1 || requests.empty()) {
    Route own(requests.empty() ? "" : requests.front().session_id());
    return ActBatchOn(requests, own);
  }
  std::map<Replica*, std::vector<size_t>> rows;
  for (size_t i = 0; i < requests.size(); ++i) {
    Route own(requests[i].session_id());
    rows[replicas_->Choose(own)].push_back(i);
  }
  BatchResults results(requests.size());
  for (const auto& [replica, group] : rows) {
    std::vector<v1::ActRequest> part;
    for (const size_t row : group) part.push_back(requests[row]);
    Route own(part.front().session_id());
    auto answers = ActBatchOn(part, own);
    if (!answers.ok()) return answers.status();
    for (size_t i = 0; i < group.size(); ++i) results[group[i]] = std::move((*answers)[i]);
  }
  return results;
}

std::unique_ptr<RemoteStream> Client::OpenStream(std::shared_ptr<Route> route) {
  if (route == nullptr) route = MakeRoute();
  return std::make_unique<RemoteStream>(this, std::move(route));
}

absl::StatusOr<v1::EndEpisodeResponse> Client::EndEpisode(const v1::EndEpisodeRequest& request,
                                                          const std::shared_ptr<Route>& route) {
  return CallOfSession(&Stub::EndEpisode, request, route);
}

absl::StatusOr<v1::GetSessionResponse> Client::GetSession(const std::string& session_id,
                                                          bool include_head_delta,
                                                          const std::shared_ptr<Route>& route) {
  v1::GetSessionRequest request;
  request.set_session_id(session_id);
  request.set_include_head_delta(include_head_delta);
  return CallOfSession(&Stub::GetSession, request, route);
}

absl::StatusOr<v1::ExplainResponse> Client::Explain(const std::string& session_id,
                                                    const std::shared_ptr<Route>& route) {
  v1::ExplainRequest request;
  request.set_session_id(session_id);
  return CallOfSession(&Stub::Explain, request, route);
}

absl::StatusOr<v1::ExportSessionResponse> Client::ExportSession(
    const std::string& session_id, bool include_policy, const std::shared_ptr<Route>& route) {
  v1::ExportSessionRequest request;
  request.set_session_id(session_id);
  request.set_include_policy(include_policy);
  return CallOfSession(&Stub::ExportSession, request, route);
}

absl::Status Client::CloseSession(const std::string& session_id,
                                  const std::shared_ptr<Route>& route) {
  v1::CloseSessionRequest request;
  request.set_session_id(session_id);
  RouteOfCall route_of_call(route, session_id);
  Attempts attempts(replicas_.get(), &route_of_call.get(), options_.retry);
  const Rules rules = {
      .timeout = options_.call_timeout, .not_found_is_done = true, .names_session = true};
  return Run(rules, attempts, [&](Line& line, grpc::ClientContext* context) {
    v1::CloseSessionResponse response;
    return line.stub->CloseSession(context, request, &response);
  });
}

}  // namespace spikeserve
