// A contestant of the benchmark: decisions of an engine without a server, including the action
// tokens.
//
// The inputs are those of the policy's environment, CartPole if it is a random one, played in
// closed loop by the policy itself. The environment is reset when its episode ends, and the context
// every --episode_steps decisions, so that policies with episodes of different lengths can be
// compared. With --observation_bound, the observations are random as those of spikeload, so that
// the engine can be compared with a server under load.

#include <CLI/CLI.hpp>
#include <iostream>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/string_view.h"
#include "core/action/action_head.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/environment.h"
#include "core/model/policy_file.h"
#include "core/quantize/quantize_integer.h"
#include "loadtest/bench/contestant.h"

namespace spikeserve {
namespace {

constexpr absl::string_view kCartPole = "CartPole-v1";  // what random policies play
constexpr int kObservationSize = 4;                     // of CartPole-v1

struct Flags {
  std::string policy;
  std::string engine = "streaming";
  std::string arithmetic;  // empty: that of the policy
  ModelConfig random;      // shape of a random policy
  int together = 1;
  int episode_steps = 500;
  float observation_bound = 0.0f;  // 0: the environment's own observations
  int print_episode = 0;           // at most so many steps to print instead of a measurement
};

// Makes the environment that a policy plays.
absl::StatusOr<std::unique_ptr<Environment>> MakeEnvironmentOf(const Policy& policy) {
  return MakeEnvironment(policy.environment.empty() ? kCartPole : policy.environment);
}

// Returns an error unless the policy can play its environment.
absl::StatusOr<Policy> ReadPlayablePolicy(const std::string& path) {
  absl::StatusOr<Policy> policy = ReadPolicyFile(path);
  if (!policy.ok()) return policy;
  ASSIGN_OR_RETURN(const auto environment, MakeEnvironmentOf(*policy));
  const int expected = environment->observation_size();
  if (policy->observation_size() == expected) return policy;
  return InvalidArgument("--policy", absl::StrCat("observations of ", expected, " elements"),
                         policy->observation_size());
}

absl::StatusOr<Policy> GivenPolicy(const Flags& flags) {
  if (!flags.policy.empty()) return ReadPlayablePolicy(flags.policy);
  ModelConfig config = flags.random;
  config.ffn_size = 4 * config.hidden_size;
  RETURN_IF_ERROR(config.Validate());
  return RandomPolicy(config, kObservationSize, ActionSpace::Discrete(2), /*seed=*/1);
}

absl::StatusOr<Policy> LoadPolicy(const Flags& flags) {
  absl::StatusOr<Policy> policy = GivenPolicy(flags);
  if (!policy.ok() || flags.arithmetic.empty()) return policy;
  ASSIGN_OR_RETURN(const Arithmetic arithmetic,
                   ParseEnum<Arithmetic>("--arithmetic", flags.arithmetic));
  if (arithmetic == policy->config.arithmetic) return policy;
  return QuantizeToInteger(*policy);  // fails for a policy that is already in integers
}

// An agent and its environment. Not thread-safe.
class Player {
 public:
  Player(const Engine* engine, const Flags& flags, uint64_t seed)
      : engine_(engine),
        environment_(*MakeEnvironmentOf(engine->policy())),
        episode_steps_(flags.episode_steps),
        observation_bound_(flags.observation_bound),
        seed_(seed),
        random_(static_cast<std::minstd_rand::result_type>(seed)),
        encoded_(static_cast<size_t>(engine->policy().action_space.size())) {
    Reset();
  }

  // Returns the inputs of the next decision. REQUIRES: Act() is called once the decision is made.
  Engine::Decision Next() {
    if (steps_++ % episode_steps_ == 0) {
      context_ = engine_->NewContext();
      if (observation_bound_ > 0) Reset();
    }
    return {context_.get(), return_to_go_, observation_, &output_};
  }

  // Executes the decided action in the environment and returns it for AppendActionsTogether.
  Engine::TakenAction Act() {
    const Policy& policy = engine_->policy();
    ChooseAction(policy.weights.head, policy.action_space, output_.readout, ActionSelection(), 0,
                 &choice_);
    policy.action_space.Encode(choice_.action, absl::MakeSpan(encoded_));
    observation_bound_ > 0 ? Observe() : Step();
    return {context_.get(), encoded_};
  }

  bool at_start() const { return at_start_; }  // of an episode
  // Prints the reward of the step before and the next observation.
  void Print() const { std::cout << reward_ << "," << absl::StrJoin(observation_, ",") << "\n"; }

  uint64_t spikes() const { return output_.counts.total_spikes(); }

 private:
  void Step() {
    const StepResult step = environment_->Step(choice_.action);
    observation_ = step.observation;
    reward_ = step.reward;
    return_to_go_ -= static_cast<float>(step.reward);
    at_start_ = false;
    if (step.done()) Reset();
  }

  // Draws an observation and receives CartPole's reward.
  void Observe() {
    std::uniform_real_distribution<float> uniform(-observation_bound_, observation_bound_);
    for (float& value : observation_) value = uniform(random_);
    return_to_go_ -= 1.0f;
  }

  void Reset() {
    observation_ = environment_->Reset(seed_++);
    reward_ = 0.0;
    at_start_ = true;
    return_to_go_ = engine_->policy().target_return;
  }

  const Engine* const engine_;
  std::unique_ptr<Environment> environment_;
  const int episode_steps_;  // decisions after which the context starts anew
  const float observation_bound_;
  uint64_t seed_;
  std::minstd_rand random_;
  int64_t steps_ = 0;
  std::unique_ptr<Engine::Context> context_;
  float return_to_go_ = 0.0f;
  double reward_ = 0.0;
  bool at_start_ = true;
  std::vector<float> observation_;
  std::vector<float> encoded_;
  Engine::Output output_;
  ActionChoice choice_;
};

// Makes one decision for each of `players`, in one batch.
Work PlayTogether(const Engine& engine, std::vector<Player>& players) {
  thread_local std::vector<Engine::Decision> decisions;
  thread_local std::vector<Engine::TakenAction> actions;
  decisions.clear();
  actions.clear();
  for (Player& player : players) decisions.push_back(player.Next());
  engine.DecideTogether(decisions);
  for (Player& player : players) actions.push_back(player.Act());
  engine.AppendActionsTogether(actions);
  Work work = {.decisions = static_cast<int64_t>(players.size())};
  for (const Player& player : players) work.spikes += player.spikes();
  return work;
}

absl::Status Run(const Flags& flags) {
  ASSIGN_OR_RETURN(auto loaded, LoadPolicy(flags));
  const auto policy = std::make_shared<const Policy>(std::move(loaded));
  const std::unique_ptr<Engine> engine =
      flags.engine == "streaming" ? MakeEngine(policy) : MakeReferenceEngine(policy);
  std::vector<Player> players;
  for (int i = 0; i < flags.together; ++i) {
    players.emplace_back(engine.get(), flags, /*seed=*/1000 * static_cast<uint64_t>(i));
  }
  if (flags.print_episode > 0) {
    for (int step = 0; step < flags.print_episode; ++step) {
      players[0].Print();
      PlayTogether(*engine, players);
      if (players[0].at_start()) break;
    }
    return absl::OkStatus();
  }
  RunContestant([&] { return PlayTogether(*engine, players); });
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::Flags flags;
  CLI::App app("A contestant of the benchmark, see contestant.h", "engine_bench");
  app.add_option("--policy", flags.policy, "Policy file; default: a random policy");
  app.add_option("--engine", flags.engine)->check(CLI::IsMember({"streaming", "reference"}));
  app.add_option("--arithmetic", flags.arithmetic,
                 "float32, int8 or integer: rounds a float32 policy; default: the policy's");
  app.add_option("--hidden_size", flags.random.hidden_size, "d of a random policy");
  app.add_option("--ticks", flags.random.ticks, "T of a random policy");
  app.add_option("--context", flags.random.context, "N of a random policy, in timesteps");
  app.add_option("--together", flags.together, "Agents that decide together");
  app.add_option("--episode_steps", flags.episode_steps, "Decisions of a context");
  app.add_option("--observation_bound", flags.observation_bound,
                 "Bound of random observations; default: those of the environment");
  app.add_option(
      "--print_episode", flags.print_episode,
      "Prints at most so many steps of an episode, as spikeload --observations reads them");
  CLI11_PARSE(app, argc, argv);
  const absl::Status status = spikeserve::Run(flags);
  if (status.ok()) return 0;
  std::cerr << "engine_bench: " << status.message() << std::endl;
  return 1;
}
