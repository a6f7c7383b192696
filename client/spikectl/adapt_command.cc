#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "client/spikectl/adaptation.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/policy_choice.h"
#include "client/spikectl/session_flags.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

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
