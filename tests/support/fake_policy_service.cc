#include "tests/support/fake_policy_service.h"

#include <grpcpp/server_builder.h>
#include <grpcpp/support/channel_arguments.h>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

grpc::Status UnknownSession(const std::string& id) {
  return {grpc::StatusCode::NOT_FOUND, absl::StrCat("session_id: no session \"", id, "\"")};
}

}  // namespace

FakePolicyService::FakePolicyService() {
  grpc::ServerBuilder builder;
  builder.RegisterService(this);
  server_ = builder.BuildAndStart();
  channel_ = server_->InProcessChannel(grpc::ChannelArguments());
}

FakePolicyService::~FakePolicyService() {
  {
    absl::MutexLock lock(&mutex_);
    ++calls_;  // releases a hanging call
    called_.SignalAll();
  }
  server_->Shutdown(std::chrono::system_clock::now());
}

void FakePolicyService::RefuseNext(int calls, grpc::Status status) {
  absl::MutexLock lock(&mutex_);
  refusals_ = calls;
  refusal_ = std::move(status);
}

void FakePolicyService::LoseNextReplies(int calls) {
  absl::MutexLock lock(&mutex_);
  lost_replies_ = calls;
}

void FakePolicyService::HangNext() {
  absl::MutexLock lock(&mutex_);
  hang_ = true;
}

void FakePolicyService::BreakNextStream(grpc::Status status) {
  absl::MutexLock lock(&mutex_);
  stream_end_ = std::move(status);
}

int FakePolicyService::calls() const {
  absl::MutexLock lock(&mutex_);
  return calls_;
}

int FakePolicyService::decisions() const {
  absl::MutexLock lock(&mutex_);
  return decisions_;
}

int FakePolicyService::sessions() const {
  absl::MutexLock lock(&mutex_);
  return static_cast<int>(sessions_.size());
}

v1::EndEpisodeRequest FakePolicyService::last_end_episode() const {
  absl::MutexLock lock(&mutex_);
  return last_end_episode_;
}

template <typename Work>
grpc::Status FakePolicyService::Handle(Work work) {
  absl::MutexLock lock(&mutex_);
  const int call = ++calls_;
  called_.SignalAll();
  if (hang_) {
    hang_ = false;
    while (calls_ == call) called_.Wait(&mutex_);
    return {grpc::StatusCode::UNAVAILABLE, "hung"};
  }
  if (refusals_ > 0) {
    --refusals_;
    return refusal_;
  }
  const grpc::Status status = work();
  if (lost_replies_ > 0) {
    --lost_replies_;
    return {grpc::StatusCode::UNAVAILABLE, "the reply was lost"};
  }
  return status;
}

grpc::Status FakePolicyService::Decide(const v1::ActRequest& request, v1::ActResponse* response) {
  const auto session = sessions_.find(request.session_id());
  if (session == sessions_.end()) return UnknownSession(request.session_id());
  SessionState& state = session->second;
  if (state.step > 0 && request.step() == state.step - 1) {
    *response = state.last_answer;
    return grpc::Status::OK;
  }
  if (request.step() != state.step) {
    return {grpc::StatusCode::FAILED_PRECONDITION,
            absl::StrCat("step: expected ", state.step, ", received ", request.step())};
  }
  ++decisions_;
  response->set_session_id(request.session_id());
  response->set_step(request.step());
  response->mutable_action()->set_discrete(decisions_ % 2);
  response->set_return_to_go(decisions_);
  response->mutable_stats()->set_spikes(kSpikes);
  state.last_answer = *response;
  ++state.step;
  return grpc::Status::OK;
}

grpc::Status FakePolicyService::ListPolicies(grpc::ServerContext*, const v1::ListPoliciesRequest*,
                                             v1::ListPoliciesResponse* response) {
  return Handle([&] {
    response->add_policies()->set_name("fake");
    return grpc::Status::OK;
  });
}

grpc::Status FakePolicyService::OpenSession(grpc::ServerContext*,
                                            const v1::OpenSessionRequest* request,
                                            v1::OpenSessionResponse* response) {
  return Handle([&]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const std::string id = absl::StrCat("session-", opened_++);
    sessions_[id] = SessionState();
    response->set_session_id(id);
    response->set_policy(request->policy());
    return grpc::Status::OK;
  });
}

grpc::Status FakePolicyService::Act(grpc::ServerContext*, const v1::ActRequest* request,
                                    v1::ActResponse* response) {
  return Handle([&]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return Decide(*request, response); });
}

grpc::Status FakePolicyService::ActBatch(grpc::ServerContext*, const v1::ActBatchRequest* request,
                                         v1::ActBatchResponse* response) {
  return Handle([&]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    for (const v1::ActRequest& item : request->requests()) {
      v1::ActResult* result = response->add_results();
      const grpc::Status status = Decide(item, result->mutable_response());
      result->set_code(status.error_code());
      result->set_message(status.error_message());
    }
    return grpc::Status::OK;
  });
}

grpc::Status FakePolicyService::ActStream(
    grpc::ServerContext*, grpc::ServerReaderWriter<v1::ActResponse, v1::ActRequest>* stream) {
  v1::ActRequest request;
  while (stream->Read(&request)) {
    v1::ActResponse response;
    std::optional<grpc::Status> end;
    {
      absl::MutexLock lock(&mutex_);
      const grpc::Status status = Decide(request, &response);
      if (!status.ok()) {
        response.set_session_id(request.session_id());
        response.set_step(request.step());
        response.mutable_error()->set_code(status.error_code());
        response.mutable_error()->set_message(status.error_message());
      }
      end = std::exchange(stream_end_, std::nullopt);
    }
    stream->Write(response);
    if (end.has_value()) return *end;
  }
  return grpc::Status::OK;
}

grpc::Status FakePolicyService::EndEpisode(grpc::ServerContext*,
                                           const v1::EndEpisodeRequest* request,
                                           v1::EndEpisodeResponse* response) {
  return Handle([&]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const auto session = sessions_.find(request->session_id());
    if (session == sessions_.end()) return UnknownSession(request->session_id());
    SessionState& state = session->second;
    if (state.step == 0 && state.episode > 0) {
      *response = state.last_end;
      return grpc::Status::OK;
    }
    last_end_episode_ = *request;
    response->set_steps(state.step);
    state = SessionState{.episode = state.episode + 1, .last_answer = {}, .last_end = *response};
    return grpc::Status::OK;
  });
}

grpc::Status FakePolicyService::GetSession(grpc::ServerContext*,
                                           const v1::GetSessionRequest* request,
                                           v1::GetSessionResponse* response) {
  return Handle([&]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const auto session = sessions_.find(request->session_id());
    if (session == sessions_.end()) return UnknownSession(request->session_id());
    response->set_session_id(request->session_id());
    response->set_step(session->second.step);
    response->set_episode(session->second.episode);
    return grpc::Status::OK;
  });
}

grpc::Status FakePolicyService::CloseSession(grpc::ServerContext*,
                                             const v1::CloseSessionRequest* request,
                                             v1::CloseSessionResponse*) {
  return Handle([&]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (sessions_.erase(request->session_id()) == 0) return UnknownSession(request->session_id());
    return grpc::Status::OK;
  });
}

}  // namespace spikeserve
