// The experiment of `spikectl adapt`: plays a task, whose physics may be perturbed, with learning
// enabled, and then evaluates the learned head.
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <iostream>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/synchronization/mutex.h"
#include "client/spikectl/agent.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/policy_choice.h"
#include "client/spikectl/session_flags.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/perturbation.h"
#include "nlohmann/json.hpp"
#include "spikeserve/client.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

struct AdaptationOptions {
  std::string environment;
  std::optional<Perturbation> perturbation;  // absent: the unperturbed task
  v1::PolicyInfo policy;                     // the policy of all sessions
  v1::LearningConfig learning;               // of every learning session
  double temperature = 1.0;                  // for sampling the actions of learning sessions
  int sessions = 1;                          // number of concurrent learning sessions
  int episodes = 1;                          // per learning session
  uint64_t seed = 0;  // session i plays episode e from start seed + e * sessions + i
  int evaluation_episodes = 50;
  uint64_t evaluation_seed = 1'000'000;  // added to `seed`: the first start for evaluation
};

struct Adaptation {
  // Mean returns of the greedy policy over starts that were not used for learning.
  double unperturbed_return = 0.0;  // the policy's own head in the unperturbed task
  double frozen_return = 0.0;       // the policy's own head in the perturbed task
  double adapted_return = 0.0;      // the learned head in the perturbed task
  std::vector<double> curve;        // return of each learning episode, the mean over the sessions
  double head_drift = 0.0;          // |W - W_base| / |W_base| of the learned head
  int64_t rollbacks = 0;            // number of rollbacks by the guard
};

// Creates the environment that is learned. Returns the errors of MakeEnvironment and
// MakePerturbedEnvironment.
absl::StatusOr<std::unique_ptr<Environment>> MakeTask(const AdaptationOptions& options) {
  if (!options.perturbation.has_value()) return MakeEnvironment(options.environment);
  return MakePerturbedEnvironment(options.environment, *options.perturbation);
}

absl::StatusOr<RemoteSession> Open(Client& client, const AdaptationOptions& options,
                                   v1::OpenSessionRequest request) {
  request.set_policy(options.policy.name());
  request.set_version(options.policy.version());
  return RemoteSession::Open(&client, std::move(request));
}

absl::StatusOr<RemoteSession> OpenLearner(Client& client, const AdaptationOptions& options,
                                          int session) {
  v1::OpenSessionRequest request;
  request.set_seed(options.seed + static_cast<uint64_t>(session));
  request.set_action_selection(v1::SAMPLE);
  request.set_temperature(options.temperature);
  *request.mutable_learning() = options.learning;
  return Open(client, options, std::move(request));
}

// Returns the mean return of a frozen, greedy session over the starts for evaluation.
absl::StatusOr<double> Evaluate(Client& client, const AdaptationOptions& options,
                                Environment& environment, const v1::OpenSessionRequest& request) {
  ASSIGN_OR_RETURN(auto session, Open(client, options, request));
  double sum = 0.0;
  for (int i = 0; i < options.evaluation_episodes; ++i) {
    const uint64_t seed = options.seed + options.evaluation_seed + static_cast<uint64_t>(i);
    ASSIGN_OR_RETURN(const auto episode, PlayEpisode(environment, session, seed));
    sum += episode.episode_return;
  }
  RETURN_IF_ERROR(session.Close());
  return sum / options.evaluation_episodes;
}

// Collects the returns of all sessions, and reports an episode when all sessions have finished it.
class Curve {
 public:
  Curve(const AdaptationOptions& options, const std::function<void(int, double)>& on_episode)
      : sessions_(options.sessions),
        on_episode_(on_episode),
        sums_(static_cast<size_t>(options.episodes), 0.0),
        counts_(static_cast<size_t>(options.episodes), 0) {}

  void Add(int episode, double episode_return) {
    absl::MutexLock lock(&mutex_);
    sums_[static_cast<size_t>(episode)] += episode_return;
    ++counts_[static_cast<size_t>(episode)];
    while (told_ < counts_.size() && counts_[told_] == sessions_) {
      on_episode_(static_cast<int>(told_), sums_[told_] / sessions_);
      ++told_;
    }
  }

  std::vector<double> Means() {
    absl::MutexLock lock(&mutex_);
    std::vector<double> means = sums_;
    for (double& mean : means) mean /= sessions_;
    return means;
  }

 private:
  const int sessions_;
  const std::function<void(int, double)>& on_episode_;
  absl::Mutex mutex_;
  std::vector<double> sums_ ABSL_GUARDED_BY(mutex_);
  std::vector<int> counts_ ABSL_GUARDED_BY(mutex_);
  size_t told_ ABSL_GUARDED_BY(mutex_) = 0;
};

absl::Status LearnAlone(const AdaptationOptions& options, int session, RemoteSession& learner,
                        Curve* curve) {
  ASSIGN_OR_RETURN(const auto environment, MakeTask(options));
  for (int e = 0; e < options.episodes; ++e) {
    const uint64_t start = static_cast<uint64_t>(e) * options.sessions + session;
    ASSIGN_OR_RETURN(const auto episode, PlayEpisode(*environment, learner, options.seed + start));
    curve->Add(e, episode.episode_return);
  }
  return absl::OkStatus();
}

// Plays all learning sessions concurrently, and stores the learned head in `learned`.
absl::Status Learn(Client& client, const AdaptationOptions& options, Curve* curve,
                   v1::GetSessionResponse* learned) {
  std::vector<RemoteSession> learners;
  for (int i = 0; i < options.sessions; ++i) {
    ASSIGN_OR_RETURN(auto learner, OpenLearner(client, options, i));
    learners.push_back(std::move(learner));
  }
  std::vector<absl::Status> statuses(learners.size());
  std::vector<std::thread> threads;
  for (size_t i = 0; i < learners.size(); ++i) {
    threads.emplace_back(
        [&, i] { statuses[i] = LearnAlone(options, static_cast<int>(i), learners[i], curve); });
  }
  for (std::thread& thread : threads) thread.join();
  for (const absl::Status& status : statuses) {
    if (!status.ok()) return status;
  }
  ASSIGN_OR_RETURN(auto session, learners[0].State(/*include_head_delta=*/true));
  *learned = std::move(session);
  for (RemoteSession& learner : learners) {
    RETURN_IF_ERROR(learner.Close());
  }
  return absl::OkStatus();
}

// Runs the experiment. Calls `on_episode(e, curve[e])` when all sessions have finished episode e,
// in order. Returns the errors of the environments and of the calls.
absl::StatusOr<Adaptation> Adapt(Client& client, const AdaptationOptions& options,
                                 const std::function<void(int, double)>& on_episode) {
  ASSIGN_OR_RETURN(const auto unperturbed, MakeEnvironment(options.environment));
  ASSIGN_OR_RETURN(const auto perturbed, MakeTask(options));

  Adaptation result;
  ASSIGN_OR_RETURN(const auto unperturbed_return, Evaluate(client, options, *unperturbed, {}));
  ASSIGN_OR_RETURN(const auto frozen_return, Evaluate(client, options, *perturbed, {}));

  Curve curve(options, on_episode);
  v1::GetSessionResponse learned;
  RETURN_IF_ERROR(Learn(client, options, &curve, &learned));
  v1::OpenSessionRequest with_head;
  *with_head.mutable_head_delta() = learned.head_delta();
  ASSIGN_OR_RETURN(const auto adapted_return, Evaluate(client, options, *perturbed, with_head));

  return Adaptation{.unperturbed_return = unperturbed_return,
                    .frozen_return = frozen_return,
                    .adapted_return = adapted_return,
                    .curve = curve.Means(),
                    .head_drift = learned.head_drift(),
                    .rollbacks = learned.rollbacks()};
}

// Returns one line of the learning curve, with a bar that is empty for `low` and full for `high`.
std::string CurveLine(int episode, double value, double low, double high) {
  constexpr int kWidth = 50;
  const double part = high > low ? (value - low) / (high - low) : 0.0;
  const int length = static_cast<int>(std::lround(kWidth * std::clamp(part, 0.0, 1.0)));
  return absl::StrFormat("%7d %10.1f |%s\n", episode, value,
                         std::string(static_cast<size_t>(length), '#'));
}

// Temperatures at which learning was reliable, see docs/design/learning.md.
constexpr double kDiscreteTemperature = 4.0;
constexpr double kContinuousTemperature = 1.0;

struct AdaptFlags {
  AgentFlags agent;  // without a target return
  int episodes = 1;
  std::string perturb;  // empty: the unperturbed task
  Scope scope = Scope::kSession;
  LearningFlags learning;
  int fleet = 16;
  std::optional<double> temperature;  // absent: as below, by the kind of actions
};

// Returns all options except the policy and the temperature, or INVALID_ARGUMENT, which names the
// flag.
absl::StatusOr<AdaptationOptions> MakeOptions(const AdaptFlags& flags) {
  AdaptationOptions options;
  options.environment = flags.agent.env;
  options.episodes = flags.episodes;
  options.seed = flags.agent.seed;
  if (options.episodes < 1) {
    return InvalidArgument("--episodes", "at least 1", options.episodes);
  }
  if (!flags.perturb.empty()) {
    auto perturbation = ParsePerturbation(flags.perturb);
    if (!perturbation.ok()) {
      return absl::InvalidArgumentError(absl::StrCat("--", perturbation.status().message()));
    }
    options.perturbation = *std::move(perturbation);
  }
  options.learning = ToProto(flags.scope, flags.learning);
  if (flags.scope == Scope::kSession) return options;
  options.sessions = flags.fleet;
  if (options.sessions < 1 || options.sessions > 1000) {
    return InvalidArgument("--fleet", "1 to 1000", options.sessions);
  }
  return options;
}

absl::StatusOr<v1::PolicyInfo> ChooseServedPolicy(Client& client, const AgentFlags& flags) {
  ASSIGN_OR_RETURN(const auto served, client.ListPolicies());
  return ChoosePolicy(served, flags.env, flags.policy.policy, flags.policy.version);
}

void PrintText(const std::string& change, const AdaptationOptions& options,
               const Adaptation& result) {
  const auto [low, high] = std::minmax_element(result.curve.begin(), result.curve.end());
  std::cout << absl::StrFormat("%s with %s, policy %s/%d, %d learning session(s)\n%7s %10s\n",
                               options.environment, change.empty() ? "nothing changed" : change,
                               options.policy.name(), options.policy.version(), options.sessions,
                               "episode", "return");
  for (size_t e = 0; e < result.curve.size(); ++e) {
    std::cout << CurveLine(static_cast<int>(e), result.curve[e], std::min(0.0, *low),
                           std::max(0.0, *high));
  }
  std::cout << absl::StrFormat(
      "greedy, mean of %d unseen starts: %.1f unperturbed, %.1f frozen, %.1f adapted\n"
      "head drift %.3f, %d rollback(s) by the guard\n",
      options.evaluation_episodes, result.unperturbed_return, result.frozen_return,
      result.adapted_return, result.head_drift, result.rollbacks);
}

void PrintJson(const AdaptationOptions& options, const Adaptation& result) {
  const ordered_json json = {{"unperturbed_return", result.unperturbed_return},
                             {"frozen_return", result.frozen_return},
                             {"adapted_return", result.adapted_return},
                             {"episodes", options.episodes},
                             {"curve", result.curve},
                             {"head_drift", result.head_drift},
                             {"rollbacks", result.rollbacks}};
  std::cout << json.dump(2) << "\n";
}

absl::Status RunAdaptation(const AdaptFlags& flags, const ServerFlags& server) {
  ASSIGN_OR_RETURN(auto options, MakeOptions(flags));
  const auto environment = MakeTask(options);
  if (absl::IsNotFound(environment.status())) return Annotate(environment.status(), "--env");
  if (!environment.ok()) {
    return absl::Status(environment.status().code(),
                        absl::StrCat("--", environment.status().message()));
  }
  const bool discrete = (*environment)->action_space().is_discrete();
  options.temperature =
      flags.temperature.value_or(discrete ? kDiscreteTemperature : kContinuousTemperature);
  if (!(options.temperature > 0.0 && std::isfinite(options.temperature))) {
    return InvalidArgument("--temperature", "a finite number above 0", options.temperature);
  }
  const ActionSelection sampled = {.sample = true,
                                   .temperature = static_cast<float>(options.temperature)};
  RETURN_IF_ERROR(
      CheckLearning(flags.scope, flags.learning, (*environment)->action_space(), sampled));
  ASSIGN_OR_RETURN(const auto client, Connect(server));
  ASSIGN_OR_RETURN(auto policy, ChooseServedPolicy(*client, flags.agent));
  RETURN_IF_ERROR(CheckSpacesMatch(policy, **environment));
  options.policy = std::move(policy);
  const bool as_text = !server.json;
  const bool on_terminal = isatty(STDERR_FILENO) == 1;
  bool in_line = false;
  const auto result = Adapt(*client, options, [&](int e, double episode_return) {
    if (!as_text) return;
    // In a file, lines. Not through std::cerr, which escapes a carriage return.
    std::fprintf(stderr, on_terminal ? "\repisode %d: %.1f   " : "episode %d: %.1f\n", e,
                 episode_return);
    in_line = on_terminal;
  });
  if (in_line) std::cerr << "\n";
  if (!result.ok()) return result.status();
  as_text ? PrintText(flags.perturb, options, *result) : PrintJson(options, *result);
  return absl::OkStatus();
}

}  // namespace

void AddAdaptCommand(Command program, const ServerFlags& server) {
  const Command command = program.AddCommand(
      "adapt", "Learns in a perturbed environment, then evaluates the learned head");
  const auto flags = std::make_shared<AdaptFlags>();
  FlagGroup playing = command.Flags("Playing");
  AddAgentFlags(playing, &flags->agent);
  playing.Add("episodes", "N", &flags->episodes, "Learning episodes of each session")
      .Add("perturb", "NAME=VALUE", &flags->perturb,
           "wind (newtons), or a factor on length, mass, force or gravity");
  FlagGroup learning = command.Flags("Learning");
  learning.Add("scope", EnumKind<Scope>(), &flags->scope, "Head that learns")
      .Add("fleet", "N", &flags->fleet, "Concurrent learning sessions with --scope=fleet")
      .Add("temperature", "T", &flags->temperature,
           "Sampling temperature; default: 1 for continuous actions, else 4");
  AddLearningFlags(command, &flags->learning);
  command.SetAction([flags, &server] { return RunAdaptation(*flags, server); });
}

}  // namespace spikeserve
