// How dependably sessions learn: `spikectl adapt` for many seeds, in one process without a server.
//
// The sessions of a fleet play each round on one head and hand over together, which is the most
// that sessions on a busy server can overlap.
#include <algorithm>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/flags/parse.h"
#include "absl/flags/usage.h"
#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/environment/perturbation.h"
#include "core/model/policy_file.h"
#include "core/session/agent_session.h"

ABSL_FLAG(std::string, policy, "deploy/policies/cartpole/1/policy.safetensors", "Policy file");
ABSL_FLAG(std::string, perturb, "", "NAME=VALUE as spikectl adapt takes it; empty: none");
ABSL_FLAG(int32_t, fleet, 0, "Sessions of a fleet; 0: one session with a head of its own");
ABSL_FLAG(int32_t, episodes, 60, "Learning episodes of each session");
ABSL_FLAG(int32_t, seeds, 10, "Repetitions");
ABSL_FLAG(int32_t, starts, 50, "Unseen starts of each evaluation");
ABSL_FLAG(double, temperature, 4.0, "At which the learning sessions sample");
ABSL_FLAG(std::string, rule, "policy_gradient", "policy_gradient or hebbian");
ABSL_FLAG(std::string, modulator, "realized", "realized or target");
ABSL_FLAG(double, learning_rate, 0.0, "0: the default of the modulator");
ABSL_FLAG(double, trace_decay, spikeserve::LearningOptions().trace_decay, "lambda");
ABSL_FLAG(double, discount, spikeserve::LearningOptions().discount, "gamma");
ABSL_FLAG(double, clip, spikeserve::LearningOptions().clip, "Longest update");
ABSL_FLAG(double, max_drift, spikeserve::LearningOptions().max_drift, "Largest relative drift");

namespace spikeserve {
namespace {

struct Experiment {
  std::shared_ptr<const Policy> policy;
  std::shared_ptr<ServedPolicy> served;
  std::unique_ptr<Environment> environment;
  SteadyClock clock;

  AgentSession Open(SessionOptions options) const {
    options.policy = "policy";
    options.version = 1;
    options.target_return = static_cast<double>(policy->target_return);
    return AgentSession(served, NewSession("id", std::move(options)), &clock);
  }
};

struct Episode {
  double episode_return = 0.0;
  EpisodeEnd end;
};

// Plays to the environment's end, but leaves the session's episode open.
Episode Play(const Experiment& experiment, AgentSession& agent, uint64_t start) {
  Episode episode;
  StepResult result{.observation = experiment.environment->Reset(start)};
  for (int64_t step = 0; !result.done(); ++step) {
    const auto answer = agent.Act(step, result.observation, result.reward);
    result = experiment.environment->Step((*answer)->action);
    episode.episode_return += result.reward;
  }
  episode.end = {
      .reward = result.reward, .terminated = result.terminated, .target_return = std::nullopt};
  return episode;
}

double Evaluate(const Experiment& experiment, uint64_t first, std::vector<float> head_delta) {
  SessionOptions options;
  options.head_delta = std::move(head_delta);
  AgentSession agent = experiment.Open(std::move(options));
  const int starts = absl::GetFlag(FLAGS_starts);
  double sum = 0.0;
  for (int i = 0; i < starts; ++i) {
    const Episode episode = Play(experiment, agent, first + static_cast<uint64_t>(i));
    (void)agent.EndEpisode(episode.end);
    sum += episode.episode_return;
  }
  return sum / starts;
}

// The return of the last tenth of the learning episodes, and of the learned head.
struct Outcome {
  double sampled = 0.0;
  double greedy = 0.0;
  double drift = 0.0;
  int64_t rollbacks = 0;
};

Outcome Learn(Experiment& experiment, const LearningOptions& learning, uint64_t seed) {
  experiment.served->fleet = std::make_shared<FleetHead>(
      experiment.policy,
      FleetOptions{.clip = learning.clip, .max_drift = learning.max_drift, .guard_margin = 0.02});
  std::vector<AgentSession> agents;
  const int sessions = std::max(1, absl::GetFlag(FLAGS_fleet));
  for (int i = 0; i < sessions; ++i) {
    SessionOptions options;
    options.seed = seed + static_cast<uint64_t>(i);
    options.action_selection = {
        .sample = true, .temperature = static_cast<float>(absl::GetFlag(FLAGS_temperature))};
    options.learning = learning;
    agents.push_back(experiment.Open(std::move(options)));
  }
  const int episodes = absl::GetFlag(FLAGS_episodes);
  const int last = std::max(1, episodes / 10);
  Outcome outcome;
  for (int e = 0; e < episodes; ++e) {
    std::vector<Episode> round;
    for (size_t i = 0; i < agents.size(); ++i) {
      round.push_back(Play(experiment, agents[i], seed + static_cast<uint64_t>(e * sessions) + i));
      if (e >= episodes - last) outcome.sampled += round[i].episode_return / (last * sessions);
    }
    for (size_t i = 0; i < agents.size(); ++i) (void)agents[i].EndEpisode(round[i].end);
  }
  outcome.greedy = Evaluate(experiment, seed + 1'000'000, agents[0].HeadDelta());
  outcome.drift = agents[0].HeadDrift();
  outcome.rollbacks = agents[0].Rollbacks();
  return outcome;
}

absl::StatusOr<LearningOptions> OptionsFromFlags(const Policy& policy) {
  LearningOptions options;
  options.scope = absl::GetFlag(FLAGS_fleet) > 0 ? Scope::kFleet : Scope::kSession;
  if (!FromString(absl::GetFlag(FLAGS_rule), &options.rule) ||
      !FromString(absl::GetFlag(FLAGS_modulator), &options.modulator)) {
    return absl::InvalidArgumentError("--rule, --modulator: expected a name of docs/learning.md");
  }
  const double rate = absl::GetFlag(FLAGS_learning_rate);
  options.learning_rate =
      rate != 0.0 ? rate : LearningOptions::DefaultLearningRate(options.modulator);
  options.trace_decay = absl::GetFlag(FLAGS_trace_decay);
  options.discount = absl::GetFlag(FLAGS_discount);
  options.clip = absl::GetFlag(FLAGS_clip);
  options.max_drift = absl::GetFlag(FLAGS_max_drift);
  if (auto status = options.Validate(policy.action_space, {.sample = true}); !status.ok()) {
    return status;
  }
  return options;
}

absl::Status Run() {
  auto policy = ReadPolicyFile(absl::GetFlag(FLAGS_policy));
  if (!policy.ok()) return policy.status();
  Experiment experiment;
  experiment.policy = std::make_shared<const Policy>(*std::move(policy));
  experiment.served = std::make_shared<ServedPolicy>();
  experiment.served->engine = MakeStreamingEngine(experiment.policy);
  experiment.served->observer = std::make_shared<SessionObserver>();
  const std::string perturb = absl::GetFlag(FLAGS_perturb);
  auto environment = MakeEnvironment(experiment.policy->environment);
  if (!perturb.empty()) {
    const auto perturbation = ParsePerturbation(perturb);
    if (!perturbation.ok()) return perturbation.status();
    environment = MakePerturbedEnvironment(experiment.policy->environment, *perturbation);
  }
  if (!environment.ok()) return environment.status();
  experiment.environment = *std::move(environment);
  const auto learning = OptionsFromFlags(*experiment.policy);
  if (!learning.ok()) return learning.status();

  const double frozen = Evaluate(experiment, 1'000'000, {});
  std::vector<double> greedy;
  for (int i = 0; i < absl::GetFlag(FLAGS_seeds); ++i) {
    const Outcome outcome = Learn(experiment, *learning, static_cast<uint64_t>(i) * 100'000);
    absl::PrintF("seed %d: last tenth sampled %.1f, greedy %.1f, drift %.2f, rollbacks %d\n", i,
                 outcome.sampled, outcome.greedy, outcome.drift, outcome.rollbacks);
    greedy.push_back(outcome.greedy);
  }
  std::sort(greedy.begin(), greedy.end());
  absl::PrintF("frozen %.1f; adapted median %.1f, least %.1f, most %.1f\n", frozen,
               (greedy[(greedy.size() - 1) / 2] + greedy[greedy.size() / 2]) / 2, greedy.front(),
               greedy.back());
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  absl::SetProgramUsageMessage("adapt_sweep: how dependably sessions learn, over many seeds.");
  absl::ParseCommandLine(argc, argv);
  const absl::Status status = spikeserve::Run();
  if (status.ok()) return 0;
  std::cerr << "adapt_sweep: " << status.message() << "\n";
  return 1;
}
