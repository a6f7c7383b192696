// A baseline for the benchmark of spikeserve: implements the calls of PolicyService on the same
// callback API of gRPC's own server, but does not compute anything. Every answer has the fields and
// the size of a real one.
//
// Prints "listening on HOST:PORT" and serves until it is killed.

#include <grpcpp/grpcpp.h>
#include <grpcpp/support/server_callback.h>

#include <atomic>
#include <iostream>
#include <string>

#include "absl/synchronization/mutex.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {
namespace {

constexpr int kObservationSize = 4;

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
  stats->set_energy_joules(4.8e-7);
  stats->set_compute_seconds(1.6e-5);
  stats->set_accumulates(20000);
  stats->set_multiply_accumulates(3000);
  stats->set_attention_products(500);
  stats->set_horowitz_energy_joules(4.8e-7);
  stats->set_membrane_updates(55040);
  stats->set_coder_gains(1408);
  stats->set_layer_norm_elements(1408);
  stats->set_softmax_terms(9600);
  stats->set_gate_products(5120);
  stats->set_integer_multiply_accumulates(1000);
  stats->set_spike_energy_joules(6.55e-10);
  stats->set_int_energy_joules(2e-8);
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
  EchoStream() { StartRead(&request_); }

  void OnReadDone(bool ok) override {
    if (!ok) return Finish(grpc::Status::OK);
    response_.Clear();
    FillAnswer(request_, &response_);
    StartWrite(&response_);
  }
  void OnWriteDone(bool ok) override {
    if (!ok) return Finish(grpc::Status::CANCELLED);
    StartRead(&request_);
  }
  void OnDone() override { delete this; }  // a gRPC reactor owns itself

 private:
  v1::ActRequest request_;
  v1::ActResponse response_;
};

class EchoService final : public v1::PolicyService::CallbackService {
 public:
  grpc::ServerUnaryReactor* ListPolicies(grpc::CallbackServerContext* context,
                                         const v1::ListPoliciesRequest*,
                                         v1::ListPoliciesResponse* response) override {
    response->add_policies()->set_name("echo");
    return Finished(context);
  }

  grpc::ServerUnaryReactor* OpenSession(grpc::CallbackServerContext* context,
                                        const v1::OpenSessionRequest*,
                                        v1::OpenSessionResponse* response) override {
    std::string id = std::to_string(sessions_.fetch_add(1));
    response->set_session_id(id.insert(0, 32 - id.size(), '0'));
    response->set_observation_size(kObservationSize);
    return Finished(context);
  }

  grpc::ServerUnaryReactor* Act(grpc::CallbackServerContext* context, const v1::ActRequest* request,
                                v1::ActResponse* response) override {
    FillAnswer(*request, response);
    return Finished(context);
  }

  grpc::ServerUnaryReactor* ActBatch(grpc::CallbackServerContext* context,
                                     const v1::ActBatchRequest* request,
                                     v1::ActBatchResponse* response) override {
    for (const v1::ActRequest& item : request->requests()) {
      FillAnswer(item, response->add_results()->mutable_response());
    }
    return Finished(context);
  }

  grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>* ActStream(
      grpc::CallbackServerContext*) override {
    return new EchoStream();
  }

  grpc::ServerUnaryReactor* EndEpisode(grpc::CallbackServerContext* context,
                                       const v1::EndEpisodeRequest*,
                                       v1::EndEpisodeResponse*) override {
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

  std::atomic<int64_t> sessions_ = 0;  // opened
};

int Run() {
  EchoService service;
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(&service);
  const auto server = builder.BuildAndStart();
  if (server == nullptr || port == 0) {
    std::cerr << "echo_server: cannot listen" << std::endl;
    return 1;
  }
  std::cout << "listening on 127.0.0.1:" << port << std::endl;
  server->Wait();
  return 0;
}

}  // namespace
}  // namespace spikeserve

int main() {
  // As spikeserve does, or the echo would pay for a check that spikeserve does not.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  return spikeserve::Run();
}
