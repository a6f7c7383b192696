// Plays whole fleets that learn one head, without an attacker: CartPole whose force acts backwards,
// so that the policy begins with about 12 steps. Whatever the guards do, no fleet may end below its
// start. Prints how often a guard restored a head.
#include <gtest/gtest.h>

#include <cstdint>
#include <iostream>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/agent/agent_session.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/perturbation.h"
#include "core/model/policy_file.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"

namespace spikeserve {
namespace {

constexpr int kSeeds = 100;
constexpr int kRounds = 30;
constexpr size_t kSessions = 16;

std::shared_ptr<const ServedPolicy> Serve(std::shared_ptr<const Policy> policy) {
  auto served = std::make_shared<ServedPolicy>();
  served->name = "cartpole";
  served->version = 1;
  served->heads = std::make_shared<TenantHeads>(policy);
  served->engine = MakeEngine(std::move(policy));
  served->observer = std::make_shared<SessionObserver>();
  return served;
}

// Plays one episode. Returns its return.
double Play(AgentSession& agent, Environment& environment, uint64_t seed) {
  StepResult result = {.observation = environment.Reset(seed)};
  double episode_return = 0.0;
  for (int64_t step = 0; !result.done(); ++step) {
    const auto answer = agent.Act(step, result.observation, result.reward);
    EXPECT_TRUE(answer.ok()) << answer.status();
    if (!answer.ok()) break;
    const Action action = (*answer)->action;
    agent.AppendPendingAction();
    result = environment.Step(action);
    episode_return += result.reward;
  }
  EpisodeEnd end;
  end.reward = result.reward;
  end.terminated = result.terminated;
  end.truncated = result.truncated;
  const auto ended = agent.EndEpisode(end);
  EXPECT_TRUE(ended.ok()) << ended.status();
  return episode_return;
}

struct FleetRun {
  std::vector<double> rounds;  // mean return of all sessions
  int64_t rollbacks = 0;
};

// The sessions play their episodes in turn, a round at a time.
FleetRun PlayFleet(const std::shared_ptr<const Policy>& policy, uint64_t seed) {
  const auto served = Serve(policy);
  FakeClock clock;
  std::vector<AgentSession> agents;
  const auto environment = MakePerturbedEnvironment("CartPole-v1", *ParsePerturbation("force=-1"));
  for (size_t i = 0; i < kSessions; ++i) {
    SessionOptions options;
    options.policy = served->name;
    options.version = 1;
    options.target_return = policy->target_return;
    options.seed = 1000 * seed + i;
    options.action_selection = {.sample = true, .temperature = 4.0f};
    options.learning = LearningOptions{.scope = Scope::kFleet};
    options.learning->learning_rate =
        LearningOptions::DefaultLearningRate(options.learning->rule, options.learning->modulator);
    agents.emplace_back(served, NewSession(absl::StrCat("s", seed, "-", i), std::move(options)),
                        &clock);
  }
  FleetRun run;
  for (int round = 0; round < kRounds; ++round) {
    double sum = 0.0;
    for (size_t i = 0; i < kSessions; ++i) {
      clock.Advance(absl::Seconds(1));
      sum += Play(agents[i], **environment, 1'000'000 + 10'000 * seed + kSessions * round + i);
    }
    run.rounds.push_back(sum / kSessions);
  }
  run.rollbacks = served->HeadOf("")->Read()->rollbacks;
  return run;
}

TEST(HonestFleetsTest, NoneEndsBelowItsStart) {
  auto read = ReadPolicyFile(SPIKESERVE_POLICIES "/cartpole/1/policy.safetensors");
  ASSERT_TRUE(read.ok()) << read.status();
  const auto policy = std::make_shared<const Policy>(*std::move(read));
  int64_t rollbacks = 0;
  for (uint64_t seed = 0; seed < kSeeds; ++seed) {
    const FleetRun run = PlayFleet(policy, seed);
    rollbacks += run.rollbacks;
    double best = 0.0;
    for (const double level : run.rounds) best = std::max(best, level);
    std::cout << "seed " << seed << ": " << run.rounds.front() << " -> " << run.rounds.back()
              << ", best round " << best << ", " << run.rollbacks << " rollbacks" << std::endl;
    EXPECT_GE(run.rounds.back(), run.rounds.front()) << "seed " << seed;
  }
  constexpr auto kWindows = kSeeds * kRounds * kSessions / ReturnGuard::kWindow;
  std::cout << rollbacks << " rollbacks in " << kWindows << " windows\n";
}

}  // namespace
}  // namespace spikeserve
