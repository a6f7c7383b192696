// Requests of the Open Inference Protocol: every message is refused and changes no sequence, or
// makes exactly one decision.
//
// An input is a list of messages, each after its length in two bytes, the most significant first.
#include <map>

#include "server/inference/inference_handler.h"
#include "tests/fuzz/fuzzed_server.h"

namespace spikeserve {
namespace {

constexpr int kMostMessages = 20;

// Returns the decisions of every open session.
std::map<std::string, uint64_t> Decisions(SessionStore& store) {
  std::map<std::string, uint64_t> decisions;
  for (const ListedSession& listed :
       store.ListAfter("", 100, [](const SessionEntry&) { return true; })) {
    absl::MutexLock lock(&listed.entry->mutex);
    decisions[listed.id] = listed.entry->agent.session().decisions;
  }
  return decisions;
}

std::string Framed(const inference::ModelInferRequest& request) {
  const std::string bytes = request.SerializeAsString();
  const auto high = static_cast<char>(bytes.size() >> 8);
  const auto low = static_cast<char>(bytes.size());
  return std::string{high, low} + bytes;
}

inference::ModelInferRequest Request(int64_t sequence, bool raw) {
  inference::ModelInferRequest request;
  request.set_model_name("small");
  (*request.mutable_parameters())["sequence_id"].set_int64_param(sequence);
  auto* input = request.add_inputs();
  input->set_name("observation");
  input->set_datatype("FP32");
  input->add_shape(1);
  input->add_shape(kObservationSize);
  const std::vector<float> observation = ObservationAt(sequence);
  if (raw) {
    request.add_raw_input_contents(observation.data(), observation.size() * sizeof(float));
  } else {
    input->mutable_contents()->mutable_fp32_contents()->Add(observation.begin(), observation.end());
  }
  return request;
}

}  // namespace

void FuzzOne(absl::string_view input) {
  InputReader reader(input);
  FuzzedServer server;
  InferenceHandler handler(
      server.registry(), &server.gate(), &server.handler(), &server.clock(), absl::Minutes(1),
      [] { return true; }, /*server=*/"");
  for (int i = 0; i < kMostMessages && !reader.empty(); ++i) {
    const size_t high = reader.Byte();
    const absl::string_view bytes = reader.Bytes(high << 8 | reader.Byte());
    inference::ModelInferRequest request;
    if (!request.ParseFromArray(bytes.data(), static_cast<int>(bytes.size()))) continue;
    const auto before = Decisions(server.store());
    inference::ModelInferResponse response;
    DeferredWork deferred;
    CallContext context = server.NewContext(&deferred);
    const auto status = handler.ModelInfer(context, request, &response);
    deferred.Run();
    const auto after = Decisions(server.store());
    int changed = 0;
    for (const auto& [id, decisions] : after) {
      const auto found = before.find(id);
      if (found != before.end() && found->second == decisions) continue;
      ++changed;
      // A new sequence begins with its first decision.
      FUZZ_CHECK(decisions == 1 || (found != before.end() && decisions == found->second + 1));
    }
    FUZZ_CHECK(changed <= (status.ok() ? 1 : 0));
    if (status.ok()) {
      FUZZ_CHECK(response.model_name() == "small");
      FUZZ_CHECK(request.outputs_size() > 0 || response.outputs_size() == 4);
    } else {
      FUZZ_CHECK(!status.message().empty());
    }
  }
}

std::vector<std::string> Seeds() {
  std::string sequence;
  for (int step = 0; step < 3; ++step) {
    auto request = Request(/*sequence=*/7, /*raw=*/step % 2 == 1);
    auto& parameters = *request.mutable_parameters();
    if (step == 0) {
      parameters["sequence_start"].set_bool_param(true);
      parameters["target_return"].set_double_param(12.0);
      parameters["seed"].set_int64_param(3);
    }
    if (step == 2) {
      parameters["sequence_end"].set_bool_param(true);
      auto* reward = request.add_inputs();
      reward->set_name("reward");
      reward->set_datatype("FP32");
      reward->add_shape(1);
      reward->mutable_contents()->add_fp32_contents(1.0f);
      request.add_outputs()->set_name("action");
    }
    sequence += Framed(request);
  }
  auto named = Request(/*sequence=*/1, /*raw=*/true);
  (*named.mutable_parameters())["sequence_id"].set_string_param("seven");
  (*named.mutable_parameters())["sequence_start"].set_bool_param(true);
  return {sequence, Framed(named) + Framed(named)};
}

}  // namespace spikeserve
