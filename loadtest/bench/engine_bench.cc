// A contestant of the benchmark: decisions through an engine alone, action tokens included.
//
// Inputs are those of CartPole, played in closed loop by the policy itself. The environment starts
// anew when its episode ends; the context starts anew every --episode_steps decisions, so that
// episodes of any length can be compared.

#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/flags/parse.h"
#include "absl/flags/usage.h"
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/environment.h"
#include "core/model/policy_file.h"
#include "loadtest/bench/contestant.h"

ABSL_FLAG(std::string, policy, "",
          "Policy file; empty: a random policy, which is as loud as one without a regulariser");
ABSL_FLAG(std::string, engine, "streaming", "streaming or reference");
ABSL_FLAG(int32_t, hidden_size, 128, "Of a random policy");
ABSL_FLAG(int32_t, ticks, 10, "Of a random policy");
ABSL_FLAG(int32_t, context, 20, "Of a random policy");
ABSL_FLAG(int32_t, together, 1, "Decisions that are made together, each for an agent of its own");
ABSL_FLAG(int32_t, episode_steps, 500, "Decisions after which the context starts anew");

namespace spikeserve {
namespace {

absl::StatusOr<Policy> LoadPolicy() {
  if (const std::string path = absl::GetFlag(FLAGS_policy); !path.empty()) {
    return ReadPolicyFile(path);
  }
  ModelConfig config;
  config.hidden_size = absl::GetFlag(FLAGS_hidden_size);
  config.ffn_size = 4 * config.hidden_size;
  config.ticks = absl::GetFlag(FLAGS_ticks);
  config.context = absl::GetFlag(FLAGS_context);
  if (auto status = config.Validate(); !status.ok()) return status;
  return RandomPolicy(config, /*observation_size=*/4, ActionSpace::Discrete(2), /*seed=*/1);
}

// An agent and its CartPole.
class Player {
 public:
  Player(const Engine* engine, uint64_t seed)
      : engine_(engine),
        environment_(*MakeEnvironment("CartPole-v1")),
        seed_(seed),
        encoded_(static_cast<size_t>(engine->policy().action_space.size())) {
    Reset();
  }

  // What the next decision takes; Act() is to follow it.
  Engine::Decision Next() {
    if (steps_++ % absl::GetFlag(FLAGS_episode_steps) == 0) context_ = engine_->NewContext(0);
    return {context_.get(), return_to_go_, observation_, &output_};
  }

  // Does what was decided, and says so; AppendActionsTogether is to follow.
  Engine::TakenAction Act() {
    const Policy& policy = engine_->policy();
    ChooseAction(policy.weights.head, policy.action_space, output_.readout, ActionSelection(), 0,
                 &choice_);
    policy.action_space.Encode(choice_.action, absl::MakeSpan(encoded_));
    const StepResult step = environment_->Step(choice_.action);
    observation_ = step.observation;
    return_to_go_ -= static_cast<float>(step.reward);
    if (step.done()) Reset();
    return {context_.get(), encoded_};
  }

  uint64_t spikes() const { return output_.counts.total_spikes(); }

 private:
  void Reset() {
    observation_ = environment_->Reset(seed_++);
    return_to_go_ = engine_->policy().target_return;
  }

  const Engine* const engine_;
  std::unique_ptr<Environment> environment_;
  uint64_t seed_;
  int64_t steps_ = 0;
  std::unique_ptr<Engine::Context> context_;
  float return_to_go_ = 0.0f;
  std::vector<float> observation_;
  std::vector<float> encoded_;
  Engine::Output output_;
  ActionChoice choice_;
};

// One decision for each of `players`.
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

absl::Status Run() {
  auto loaded = LoadPolicy();
  if (!loaded.ok()) return loaded.status();
  const auto policy = std::make_shared<const Policy>(*std::move(loaded));
  const std::string name = absl::GetFlag(FLAGS_engine);
  if (name != "streaming" && name != "reference") {
    return absl::InvalidArgumentError(
        absl::StrCat("--engine: expected streaming or reference, received \"", name, "\""));
  }
  const std::unique_ptr<Engine> engine =
      name == "streaming" ? MakeStreamingEngine(policy) : MakeReferenceEngine(policy);
  std::vector<Player> players;
  for (int i = 0; i < absl::GetFlag(FLAGS_together); ++i) {
    players.emplace_back(engine.get(), /*seed=*/1000 * static_cast<uint64_t>(i));
  }
  RunContestant([&] { return PlayTogether(*engine, players); });
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  absl::SetProgramUsageMessage("engine_bench: a contestant of the benchmark, see contestant.h");
  absl::ParseCommandLine(argc, argv);
  const absl::Status status = spikeserve::Run();
  if (status.ok()) return 0;
  std::cerr << "engine_bench: " << status.message() << std::endl;
  return 1;
}
