// A contestant of the benchmark: the same model, or a dense decision transformer of its size, in
// eager libtorch on one thread, in steady state.
//
// usage: torch_bench --model=snn|dense|dense_cached|dense_cached_int8 --policy=FILE
//        torch_bench --export=FILE
//
// --policy is the policy of the snn. The dense models have random weights, because weights do not
// change their cost. --export writes the policy of the dense models and prints, as a JSON array,
// the logits that the engine computes from it for the observations of CheckObservation.

#include <torch/torch.h>

#include <CLI/CLI.hpp>
#include <cmath>
#include <functional>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/action/action_head.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "lab/bench/cached_dense.h"
#include "loadtest/bench/contestant.h"
#include "train/model/torch_model.h"

namespace spikeserve {
namespace {

using Decide = std::function<Work()>;

struct Flags {
  std::string model = "snn";
  std::string policy;
  std::string export_file;
};

// One clip of a full window, as a stateless server recomputes it at every decision.
Decide FullWindow(Policy policy) {
  const int n = policy.config.context;
  const ClipTensors clip = {.return_to_go = torch::full({1, n}, policy.target_return),
                            .observations = torch::randn({1, n, policy.observation_size()}) * 0.1,
                            .actions = torch::eye(policy.action_space.size())
                                           .index({torch::arange(n) % policy.action_space.size()})
                                           .unsqueeze(0),
                            .timesteps = torch::arange(n).unsqueeze(0),
                            .previous = {}};
  const auto model = std::make_shared<const TorchModel>(std::move(policy), Surrogate());
  return [model, clip] {
    model->Forward(clip);
    return Work{.decisions = 1};
  };
}

Policy DensePolicy() {
  ModelConfig config;
  config.mode = Mode::kDense;
  return RandomPolicy(config, 4, ActionSpace::Discrete(2), /*seed=*/1);
}

// The inputs of the check of the models: the first action at every timestep, a return-to-go of 1,
// and these observations. There are enough timesteps that no part of the initially empty window is
// left.
int64_t CheckDecisions(const Policy& policy) { return 3 * policy.config.context; }
std::vector<float> CheckObservation(int64_t timestep) {
  std::vector<float> observation;
  for (int i = 0; i < 4; ++i) {
    observation.push_back(std::sin(0.3f * static_cast<float>(timestep + i)));
  }
  return observation;
}

// Returns the logits of the engine in dense mode for the last timestep of the check.
std::vector<float> EngineLogits(const std::shared_ptr<const Policy>& policy) {
  const auto engine = MakeEngine(policy);
  const auto context = engine->NewContext();
  Engine::Output output;
  for (int64_t t = 0; t < CheckDecisions(*policy); ++t) {
    engine->Decide(*context, 1.0f, CheckObservation(t), &output);
    engine->AppendAction(*context, std::vector<float>{1.0f, 0.0f});
  }
  return ChooseAction(policy->weights.head, policy->action_space, output.readout, ActionSelection(),
                      0)
      .logits;
}

// Returns INTERNAL if CachedDense computes other logits than the engine in dense mode, so that only
// a correct model is measured.
absl::Status CheckAgainstEngine(const std::shared_ptr<const Policy>& policy, bool int8) {
  const float tolerance = int8 ? 0.1f : 1e-3f;
  CachedDense cached(*policy, int8);
  const torch::Tensor action = torch::tensor({{1.0f, 0.0f}});
  torch::Tensor logits;
  for (int64_t t = 0; t < CheckDecisions(*policy); ++t) {
    const torch::Tensor observation = torch::tensor(CheckObservation(t)).view({1, 4});
    logits = cached.Decide(t, action, torch::ones({1, 1}), observation);
  }
  const std::vector<float> expected = EngineLogits(policy);
  for (size_t i = 0; i < expected.size(); ++i) {
    const float received = logits[0][static_cast<int64_t>(i)].item<float>();
    if (std::abs(received - expected[i]) <= tolerance) continue;
    return absl::InternalError(absl::StrCat("dense_cached: logit ", i, ": expected ", expected[i],
                                            ", received ", received));
  }
  return absl::OkStatus();
}

// Writes the policy of the dense models to `path` and prints the engine's logits.
absl::Status Export(const std::string& path) {
  const Policy policy = DensePolicy();
  std::cout << "[" << absl::StrJoin(EngineLogits(std::make_shared<const Policy>(policy)), ", ")
            << "]" << std::endl;
  return WritePolicyFile(policy, path);
}

absl::StatusOr<Decide> CachedWindow(const Policy& policy, bool int8) {
  if (auto status = CheckAgainstEngine(std::make_shared<const Policy>(policy), int8);
      !status.ok()) {
    return status;
  }
  const auto model = std::make_shared<CachedDense>(policy, int8);
  const torch::Tensor action = torch::tensor({{1.0f, 0.0f}});
  const torch::Tensor return_to_go = torch::ones({1, 1});
  const torch::Tensor observation = torch::randn({1, policy.observation_size()});
  return [=, timestep = int64_t{0}]() mutable {
    model->Decide(timestep++, action, return_to_go, observation);
    return Work{.decisions = 1};
  };
}

absl::StatusOr<Decide> MakeDecide(const Flags& flags) {
  if (flags.model == "snn") {
    ASSIGN_OR_RETURN(auto policy, ReadPolicyFile(flags.policy));
    return FullWindow(std::move(policy));
  }
  if (flags.model == "dense") return FullWindow(DensePolicy());
  return CachedWindow(DensePolicy(), /*int8=*/flags.model == "dense_cached_int8");
}

absl::Status Run(const Flags& flags) {
  if (!flags.export_file.empty()) return Export(flags.export_file);
  at::set_num_threads(1);
  const torch::NoGradGuard no_grad;
  ASSIGN_OR_RETURN(const auto decide, MakeDecide(flags));
  RunContestant(decide);
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::Flags flags;
  CLI::App app("A contestant of the benchmark, see contestant.h", "torch_bench");
  app.add_option("--model", flags.model, "dense: full window")
      ->check(CLI::IsMember({"snn", "dense", "dense_cached", "dense_cached_int8"}));
  app.add_option("--policy", flags.policy, "Policy file of the snn");
  app.add_option("--export", flags.export_file, "Policy file to write for another contestant");
  CLI11_PARSE(app, argc, argv);
  const absl::Status status = spikeserve::Run(flags);
  if (status.ok()) return 0;
  std::cerr << "torch_bench: " << status.message() << std::endl;
  return 1;
}
