// A PolicyService in the process of the test that can be told to fail. It follows the contract of
// steps: a repeated request for the last step gets the stored answer. Every new decision differs
// from all previous ones, so that a test notices a step that is decided twice.
//
// Thread-safe. Example:
//
//   FakePolicyService fake;
//   const auto client = *Client::Create(fake.channel(), options);
//   fake.LoseNextReplies(1);
#pragma once

#include <grpcpp/channel.h>
#include <grpcpp/server.h>

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {

class FakePolicyService : public v1::PolicyService::Service {
 public:
  static constexpr uint64_t kSpikes = 10;  // reported for every decision

  FakePolicyService();
  ~FakePolicyService() override;

  std::shared_ptr<grpc::Channel> channel() const { return channel_; }

  // Makes the next `calls` calls fail with `status`, without any effect.
  void RefuseNext(int calls, grpc::Status status);
  // Executes the next `calls` calls, but answers them with UNAVAILABLE.
  void LoseNextReplies(int calls);
  // Makes the next call have no effect and return only when another call arrives.
  void HangNext();
  // Ends the next stream with `status` after its first answer.
  void BreakNextStream(grpc::Status status);

  int calls() const;      // unary calls received, including refused ones
  int decisions() const;  // computed decisions, without repeated answers
  int sessions() const;   // open sessions
  v1::EndEpisodeRequest last_end_episode() const;

  grpc::Status ListPolicies(grpc::ServerContext* context, const v1::ListPoliciesRequest* request,
                            v1::ListPoliciesResponse* response) override;
  grpc::Status OpenSession(grpc::ServerContext* context, const v1::OpenSessionRequest* request,
                           v1::OpenSessionResponse* response) override;
  grpc::Status Act(grpc::ServerContext* context, const v1::ActRequest* request,
                   v1::ActResponse* response) override;
  grpc::Status ActBatch(grpc::ServerContext* context, const v1::ActBatchRequest* request,
                        v1::ActBatchResponse* response) override;
  grpc::Status ActStream(
      grpc::ServerContext* context,
      grpc::ServerReaderWriter<v1::ActResponse, v1::ActRequest>* stream) override;
  grpc::Status EndEpisode(grpc::ServerContext* context, const v1::EndEpisodeRequest* request,
                          v1::EndEpisodeResponse* response) override;
  grpc::Status GetSession(grpc::ServerContext* context, const v1::GetSessionRequest* request,
                          v1::GetSessionResponse* response) override;
  grpc::Status CloseSession(grpc::ServerContext* context, const v1::CloseSessionRequest* request,
                            v1::CloseSessionResponse* response) override;

 private:
  struct SessionState {
    int64_t step = 0;
    int64_t episode = 0;
    v1::ActResponse last_answer;
    v1::EndEpisodeResponse last_end;
  };

  // Counts the call, applies the requested faults, and runs `work` unless a fault prevents it.
  template <typename Work>
  grpc::Status Handle(Work work) ABSL_LOCKS_EXCLUDED(mutex_);
  grpc::Status Decide(const v1::ActRequest& request, v1::ActResponse* response)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  mutable absl::Mutex mutex_;
  absl::CondVar called_;  // signalled when calls_ grows
  std::map<std::string, SessionState> sessions_ ABSL_GUARDED_BY(mutex_);
  int calls_ ABSL_GUARDED_BY(mutex_) = 0;
  int decisions_ ABSL_GUARDED_BY(mutex_) = 0;
  int opened_ ABSL_GUARDED_BY(mutex_) = 0;
  int refusals_ ABSL_GUARDED_BY(mutex_) = 0;
  grpc::Status refusal_ ABSL_GUARDED_BY(mutex_);
  int lost_replies_ ABSL_GUARDED_BY(mutex_) = 0;
  bool hang_ ABSL_GUARDED_BY(mutex_) = false;
  std::optional<grpc::Status> stream_end_ ABSL_GUARDED_BY(mutex_);
  v1::EndEpisodeRequest last_end_episode_ ABSL_GUARDED_BY(mutex_);

  std::unique_ptr<grpc::Server> server_;
  std::shared_ptr<grpc::Channel> channel_;
};

}  // namespace spikeserve
