// A baseline for the benchmark of spikeserve: implements the calls of PolicyService on the same
// gRPC callback API, but does not compute anything. Every answer has the fields and the size of a
// real one. With --policy it also computes a decision with the engine for every answer, which gives
// the cost of a server whose sessions, limits and metrics are free.
//
// Prints "listening on HOST:PORT" and serves until it is killed.

#include <grpcpp/grpcpp.h>
#include <grpcpp/support/server_callback.h>

#include <CLI/CLI.hpp>
#include <charconv>
#include <deque>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "core/action/action_head.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {
namespace {

constexpr int kObservationSize = 4;

// The open sessions. Thread-safe.
class Sessions {
 public:
  // `engine` may be null; sessions then have no state.
  explicit Sessions(std::unique_ptr<Engine> engine) : engine_(std::move(engine)) {}

  std::string Open() {
    absl::MutexLock lock(&mutex_);
    std::string id = std::to_string(sessions_.size());
    sessions_.emplace_back();
    id.insert(0, 32 - id.size(), '0');
    return id;
  }

  void Reset(const std::string& id) {
    Session& session = Find(id);
    absl::MutexLock lock(&session.mutex);
    session.context = nullptr;
  }

  // Computes a decision and appends its action token to the context. Does nothing without an
  // engine.
  void Decide(const v1::ActRequest& request) {
    if (engine_ == nullptr) return;
    Session& session = Find(request.session_id());
    absl::MutexLock lock(&session.mutex);
    if (session.context == nullptr) session.context = engine_->NewContext(0);
    thread_local Engine::Output output;
    thread_local ActionChoice choice;
    thread_local std::vector<float> encoded;
    const Policy& policy = engine_->policy();
    const auto return_to_go = static_cast<float>(policy.target_return - request.step());
    engine_->Decide(*session.context, return_to_go, request.observation(), &output);
    ChooseAction(policy.weights.head, policy.action_space, output.readout, ActionSelection(), 0,
                 &choice);
    encoded.resize(static_cast<size_t>(policy.action_space.size()));
    policy.action_space.Encode(choice.action, absl::MakeSpan(encoded));
    engine_->AppendAction(*session.context, encoded);
  }

 private:
  struct Session {
    absl::Mutex mutex;
    // Null before the first step of an episode.
    std::unique_ptr<Engine::Context> context ABSL_GUARDED_BY(mutex);
  };

  Session& Find(const std::string& id) {
    size_t index = 0;
    std::from_chars(id.data(), id.data() + id.size(), index);
    absl::MutexLock lock(&mutex_);
    return sessions_.at(index);
  }

  const std::unique_ptr<Engine> engine_;
  absl::Mutex mutex_;
  std::deque<Session> sessions_ ABSL_GUARDED_BY(mutex_);  // a deque keeps references valid
};

// Fills in an answer with constants of typical size.
void FillAnswer(const v1::ActRequest& request, v1::ActResponse* response) {
  response->set_session_id(request.session_id());
  response->set_step(request.step());
  response->mutable_action()->set_discrete(1);
  response->add_action_probabilities(0.25f);
  response->add_action_probabilities(0.75f);
  response->set_return_to_go(request.reward());
  v1::DecisionStats* stats = response->mutable_stats();
  stats->set_spikes(131);
  stats->set_synaptic_operations(23000);
  stats->set_energy_joules(6.55e-10);
  stats->set_compute_seconds(1.6e-5);
  stats->set_accumulates(20000);
  stats->set_multiply_accumulates(3000);
  stats->set_attention_products(500);
  stats->set_horowitz_energy_joules(3e-8);
  v1::SpikesByStage* spikes = stats->mutable_spikes_by_stage();
  spikes->set_coder(30);
  spikes->set_phase(20);
  spikes->set_query(10);
  spikes->set_key(10);
  spikes->set_value(11);
  spikes->set_ffn_in(20);
  spikes->set_ffn_hidden(20);
  spikes->set_readout(10);
}

class EchoStream final : public grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse> {
 public:
  explicit EchoStream(Sessions* sessions) : sessions_(sessions) { StartRead(&request_); }

  void OnReadDone(bool ok) override {
    if (!ok) return Finish(grpc::Status::OK);
    response_.Clear();
    sessions_->Decide(request_);
    FillAnswer(request_, &response_);
    StartWrite(&response_);
  }
  void OnWriteDone(bool ok) override {
    if (!ok) return Finish(grpc::Status::CANCELLED);
    StartRead(&request_);
  }
  void OnDone() override { delete this; }  // a gRPC reactor owns itself

 private:
  Sessions* const sessions_;
  v1::ActRequest request_;
  v1::ActResponse response_;
};

class EchoService final : public v1::PolicyService::CallbackService {
 public:
  explicit EchoService(Sessions* sessions) : sessions_(sessions) {}

  grpc::ServerUnaryReactor* ListPolicies(grpc::CallbackServerContext* context,
                                         const v1::ListPoliciesRequest*,
                                         v1::ListPoliciesResponse* response) override {
    response->add_policies()->set_name("echo");
    return Finished(context);
  }

  grpc::ServerUnaryReactor* OpenSession(grpc::CallbackServerContext* context,
                                        const v1::OpenSessionRequest*,
                                        v1::OpenSessionResponse* response) override {
    response->set_session_id(sessions_->Open());
    response->set_observation_size(kObservationSize);
    return Finished(context);
  }

  grpc::ServerUnaryReactor* Act(grpc::CallbackServerContext* context, const v1::ActRequest* request,
                                v1::ActResponse* response) override {
    sessions_->Decide(*request);
    FillAnswer(*request, response);
    return Finished(context);
  }

  grpc::ServerUnaryReactor* ActBatch(grpc::CallbackServerContext* context,
                                     const v1::ActBatchRequest* request,
                                     v1::ActBatchResponse* response) override {
    for (const v1::ActRequest& item : request->requests()) {
      sessions_->Decide(item);
      FillAnswer(item, response->add_results()->mutable_response());
    }
    return Finished(context);
  }

  grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>* ActStream(
      grpc::CallbackServerContext*) override {
    return new EchoStream(sessions_);
  }

  grpc::ServerUnaryReactor* EndEpisode(grpc::CallbackServerContext* context,
                                       const v1::EndEpisodeRequest* request,
                                       v1::EndEpisodeResponse*) override {
    sessions_->Reset(request->session_id());
    return Finished(context);
  }

  grpc::ServerUnaryReactor* CloseSession(grpc::CallbackServerContext* context,
                                         const v1::CloseSessionRequest*,
                                         v1::CloseSessionResponse*) override {
    return Finished(context);
  }

 private:
  static grpc::ServerUnaryReactor* Finished(grpc::CallbackServerContext* context) {
    grpc::ServerUnaryReactor* reactor = context->DefaultReactor();
    reactor->Finish(grpc::Status::OK);
    return reactor;
  }

  Sessions* const sessions_;
};

absl::Status Run(const std::string& policy_file) {
  std::unique_ptr<Engine> engine;
  if (!policy_file.empty()) {
    auto policy = ReadPolicyFile(policy_file);
    if (!policy.ok()) return policy.status();
    engine = MakeStreamingEngine(std::make_shared<const Policy>(*std::move(policy)));
  }
  Sessions sessions(std::move(engine));
  EchoService service(&sessions);
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(&service);
  const auto server = builder.BuildAndStart();
  if (server == nullptr || port == 0) return absl::UnavailableError("cannot listen");
  std::cout << "listening on 127.0.0.1:" << port << std::endl;
  server->Wait();
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  std::string policy_file;
  CLI::App app("What spikeserve is measured against", "echo_server");
  app.add_option("--policy", policy_file, "Policy file whose engine decides; default: none");
  CLI11_PARSE(app, argc, argv);
  // As spikeserve does, or the echo would pay for a check that spikeserve does not.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  const absl::Status status = spikeserve::Run(policy_file);
  if (status.ok()) return 0;
  std::cerr << "echo_server: " << status.message() << std::endl;
  return 1;
}
