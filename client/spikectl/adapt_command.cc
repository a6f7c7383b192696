#include <algorithm>
#include <iostream>
#include <string>

#include "absl/flags/declare.h"
#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/types/optional.h"
#include "client/spikectl/adaptation.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/common_flags.h"
#include "client/spikectl/policy_choice.h"
#include "nlohmann/json.hpp"

ABSL_DECLARE_FLAG(std::string, env);
ABSL_DECLARE_FLAG(int32_t, episodes);
ABSL_DECLARE_FLAG(uint64_t, seed);
ABSL_DECLARE_FLAG(std::string, policy);
ABSL_DECLARE_FLAG(int64_t, version);
ABSL_FLAG(std::string, perturb, "",
          "NAME=VALUE: wind (newtons), or a factor on length, mass, force or gravity; empty: the "
          "task as it is (adapt)");
ABSL_FLAG(std::string, rule, "policy_gradient", "policy_gradient or hebbian (adapt)");
ABSL_FLAG(std::string, modulator, "realized", "realized or target (adapt)");
ABSL_FLAG(std::string, scope, "session", "session or fleet: whose head learns (adapt)");
ABSL_FLAG(int32_t, fleet, 16, "Sessions that learn at once with --scope=fleet (adapt)");
ABSL_FLAG(absl::optional<double>, temperature, absl::nullopt,
          "At which the learning sessions sample; unset: 1 for continuous actions, else 4 (adapt)");
ABSL_FLAG(absl::optional<double>, learning_rate, absl::nullopt,
          "Unset: the server's own for the modulator (adapt)");
ABSL_FLAG(absl::optional<double>, discount, absl::nullopt,
          "Of the realized return; unset: the server's own (adapt)");

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

// Where learning was dependable: docs/learning.md.
constexpr double kDiscreteTemperature = 4.0;
constexpr double kContinuousTemperature = 1.0;

absl::StatusOr<AdaptationOptions> OptionsFromFlags() {
  AdaptationOptions options;
  options.environment = absl::GetFlag(FLAGS_env);
  options.episodes = absl::GetFlag(FLAGS_episodes);
  options.seed = absl::GetFlag(FLAGS_seed);
  if (options.episodes < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("--episodes: expected at least 1, received ", options.episodes));
  }
  if (const std::string perturb = absl::GetFlag(FLAGS_perturb); !perturb.empty()) {
    auto perturbation = ParsePerturbation(perturb);
    if (!perturbation.ok()) {
      return absl::InvalidArgumentError(absl::StrCat("--", perturbation.status().message()));
    }
    options.perturbation = *std::move(perturbation);
  }
  options.learning.set_rule(absl::GetFlag(FLAGS_rule));
  options.learning.set_modulator(absl::GetFlag(FLAGS_modulator));
  if (const auto rate = absl::GetFlag(FLAGS_learning_rate)) {
    options.learning.set_learning_rate(*rate);
  }
  if (const auto discount = absl::GetFlag(FLAGS_discount)) options.learning.set_discount(*discount);
  const std::string scope = absl::GetFlag(FLAGS_scope);
  if (scope != "session" && scope != "fleet") {
    return absl::InvalidArgumentError(
        absl::StrCat("--scope: expected session or fleet, received \"", scope, "\""));
  }
  if (scope == "session") return options;
  options.learning.set_scope(v1::LearningConfig::FLEET);
  options.sessions = absl::GetFlag(FLAGS_fleet);
  if (options.sessions < 1 || options.sessions > 1000) {
    return absl::InvalidArgumentError(
        absl::StrCat("--fleet: expected 1 to 1000, received ", options.sessions));
  }
  return options;
}

absl::StatusOr<v1::PolicyInfo> PolicyFromFlags(Client& client, const std::string& environment) {
  const auto served = client.ListPolicies();
  if (!served.ok()) return served.status();
  return ChoosePolicy(*served, environment, absl::GetFlag(FLAGS_policy),
                      absl::GetFlag(FLAGS_version));
}

void PrintText(const AdaptationOptions& options, const Adaptation& result) {
  const auto [low, high] = std::minmax_element(result.curve.begin(), result.curve.end());
  const std::string change = absl::GetFlag(FLAGS_perturb);
  absl::PrintF("%s with %s, policy %s/%d, %d learning session(s)\n", options.environment,
               change.empty() ? "nothing changed" : change, options.policy.name(),
               options.policy.version(), options.sessions);
  absl::PrintF("%7s %10s\n", "episode", "return");
  for (size_t e = 0; e < result.curve.size(); ++e) {
    std::cout << CurveLine(static_cast<int>(e), result.curve[e], std::min(0.0, *low),
                           std::max(0.0, *high));
  }
  absl::PrintF(
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

}  // namespace

absl::Status AdaptCommand() {
  auto options = OptionsFromFlags();
  if (!options.ok()) return options.status();
  const auto environment = MakeTask(*options);
  if (!environment.ok()) {
    return absl::Status(environment.status().code(),
                        absl::StrCat("--", environment.status().message()));
  }
  const bool discrete = (*environment)->action_space().is_discrete();
  options->temperature = absl::GetFlag(FLAGS_temperature)
                             .value_or(discrete ? kDiscreteTemperature : kContinuousTemperature);
  const auto client = ConnectToServer();
  if (!client.ok()) return client.status();
  auto policy = PolicyFromFlags(**client, options->environment);
  if (!policy.ok()) return policy.status();
  if (absl::Status status = CheckFits(*policy, **environment); !status.ok()) return status;
  options->policy = *std::move(policy);
  const bool as_text = !absl::GetFlag(FLAGS_json);
  bool in_line = false;
  const auto result = Adapt(**client, *options, [&](int e, double episode_return) {
    if (as_text) std::cerr << absl::StrFormat("\repisode %d: %.1f   ", e, episode_return);
    in_line = as_text;
  });
  if (in_line) std::cerr << "\n";
  if (!result.ok()) return result.status();
  as_text ? PrintText(*options, *result) : PrintJson(*options, *result);
  return absl::OkStatus();
}

}  // namespace spikeserve
