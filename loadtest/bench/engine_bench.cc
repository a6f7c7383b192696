// Decisions a second through the engines alone, on one core: the shipped CartPole policy in closed
// loop with its environment, and a random policy of the same size, which is as loud as an
// unregularised one.
//
// usage: engine_bench [Google Benchmark flags]; run from the repository root, where deploy/policies
// is.

#include <benchmark/benchmark.h>

#include <memory>
#include <string>

#include "core/engine/action_head.h"
#include "core/engine/engine.h"
#include "core/environment/environment.h"
#include "core/model/policy_file.h"

namespace spikeserve {
namespace {

constexpr char kShippedPolicy[] = "deploy/policies/cartpole/1/policy.safetensors";

std::shared_ptr<const Policy> ShippedPolicy() {
  absl::StatusOr<Policy> policy = ReadPolicyFile(kShippedPolicy);
  return policy.ok() ? std::make_shared<const Policy>(*std::move(policy)) : nullptr;
}

std::shared_ptr<const Policy> RandomCartPolePolicy() {
  return std::make_shared<const Policy>(
      RandomPolicy(ModelConfig(), 4, ActionSpace::Discrete(2), /*seed=*/1));
}

// One decision an iteration, its action token included; the environment's share is noise beside it.
void Decide(benchmark::State& state, const std::shared_ptr<const Policy>& policy, bool streaming) {
  if (policy == nullptr)
    return state.SkipWithError("no shipped policy: run from the repository root");
  const std::unique_ptr<Engine> engine =
      streaming ? MakeStreamingEngine(policy) : MakeReferenceEngine(policy);
  auto environment = *MakeEnvironment("CartPole-v1");
  std::unique_ptr<Engine::Context> context;
  std::vector<float> observation, encoded(policy->action_space.size());
  Engine::Output output;
  uint64_t seed = 1, spikes = 0;
  float return_to_go = 0.0f;
  for (auto _ : state) {
    if (context == nullptr) {
      observation = environment->Reset(seed++);
      context = engine->NewContext(0);
      return_to_go = policy->target_return;
    }
    engine->Decide(*context, return_to_go, observation, &output);
    const Action action = ChooseAction(policy->weights.head, policy->action_space, output.readout,
                                       ActionSelection(), 0)
                              .action;
    policy->action_space.Encode(action, absl::MakeSpan(encoded));
    engine->AppendAction(*context, encoded);
    const StepResult step = environment->Step(action);
    observation = step.observation;
    return_to_go -= static_cast<float>(step.reward);
    spikes += output.counts.total_spikes();
    if (step.done()) context.reset();
  }
  state.counters["decisions/s"] =
      benchmark::Counter(static_cast<double>(state.iterations()), benchmark::Counter::kIsRate);
  state.counters["spikes/decision"] =
      static_cast<double>(spikes) / static_cast<double>(state.iterations());
}

BENCHMARK_CAPTURE(Decide, streaming_shipped, ShippedPolicy(), true)->Unit(benchmark::kMicrosecond);
BENCHMARK_CAPTURE(Decide, streaming_random, RandomCartPolePolicy(), true)
    ->Unit(benchmark::kMicrosecond);
// The reference recomputes the episode, so its cost grows with it: a fixed number of decisions
// keeps runs alike.
BENCHMARK_CAPTURE(Decide, reference_random, RandomCartPolePolicy(), false)
    ->Unit(benchmark::kMicrosecond)
    ->Iterations(20);

}  // namespace
}  // namespace spikeserve

BENCHMARK_MAIN();
