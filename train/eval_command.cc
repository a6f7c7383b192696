#include <cmath>
#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/policy_file.h"
#include "train/commands.h"
#include "train/evaluation/ablation.h"
#include "train/evaluation/evaluation.h"
#include "train/evaluation/paired_evaluation.h"
#include "train/evaluation/return_response.h"
#include "train/record_flags.h"

namespace spikeserve {
namespace {

struct EvalFlags {
  std::string policy;
  std::string against;             // empty: no second policy
  std::optional<std::string> env;  // absent: the policy's
  EvaluationOptions options;
  std::vector<std::string> target_returns;  // empty: the default of the policy
  std::vector<std::string> ablate;
  bool json = false;
};

absl::StatusOr<std::vector<double>> ParseTargetReturns(const EvalFlags& flags) {
  std::vector<double> targets;
  for (const std::string& text : flags.target_returns) {
    double target = 0.0;
    if (!absl::SimpleAtod(text, &target) || !std::isfinite(target)) {
      return InvalidArgument("--target_returns", "finite numbers", absl::StrCat("\"", text, "\""));
    }
    targets.push_back(target);
  }
  return targets;
}

// Reads --policy for the environment of --env, and switches off the parts of --ablate.
absl::StatusOr<Policy> ReadPolicy(const EvalFlags& flags) {
  if (flags.policy.empty()) {
    return InvalidArgument("--policy", "a policy file", "none");
  }
  absl::StatusOr<Policy> policy = ReadPolicyFile(flags.policy);
  if (!policy.ok()) return policy;
  policy->environment = flags.env.value_or(policy->environment);
  for (const std::string& part : flags.ablate) {
    if (auto status = Ablate(part, &*policy); !status.ok()) return NameFlag(status);
  }
  return policy;
}

void Print(const EvalFlags& flags, const nlohmann::ordered_json& json, const std::string& text) {
  std::fputs((flags.json ? json.dump(2) + "\n" : text).c_str(), stdout);
}

// Plays the policy of --against and `policy` on the same starts.
absl::Status Compare(const EvalFlags& flags, const Policy& policy) {
  if (!flags.target_returns.empty()) {
    return InvalidArgument("--target_returns", "none with --against", flags.target_returns.front());
  }
  ASSIGN_OR_RETURN(Policy other, ReadPolicyFile(flags.against));
  other.environment = policy.environment;
  ASSIGN_OR_RETURN(const PairedEvaluation pair,
                   EvaluatePair(std::make_shared<const Policy>(other),
                                std::make_shared<const Policy>(policy), flags.options));
  Print(flags,
        {{"against", ToJson(pair.first, other.config)},
         {"policy", ToJson(pair.second, policy.config)},
         {"paired_returns", ToJson(pair)}},
        absl::StrCat(flags.against, ": ", ToText(pair.first, other.config), flags.policy, ": ",
                     ToText(pair.second, policy.config),
                     ToText(pair, "of --against", "of --policy")));
  return absl::OkStatus();
}

absl::Status EvaluatePolicy(const EvalFlags& flags) {
  ASSIGN_OR_RETURN(Policy policy, ReadPolicy(flags));
  if (!flags.against.empty()) return Compare(flags, policy);
  ASSIGN_OR_RETURN(const std::vector<double> targets, ParseTargetReturns(flags));
  if (targets.size() > 1) {
    ASSIGN_OR_RETURN(const ReturnResponse response,
                     MeasureReturnResponse(policy, targets, flags.options));
    Print(flags, ToJson(response), ToText(response));
    return absl::OkStatus();
  }
  if (!targets.empty()) policy.target_return = static_cast<float>(targets.front());
  const ModelConfig config = policy.config;
  ASSIGN_OR_RETURN(const Evaluation evaluation,
                   Evaluate(std::make_shared<const Policy>(std::move(policy)), flags.options));
  Print(flags, ToJson(evaluation, config), ToText(evaluation, config));
  return absl::OkStatus();
}

}  // namespace

void AddEvalCommand(Program& program) {
  const Command command = program.root().AddCommand("eval", "Plays a policy in closed loop");
  const auto flags = std::make_shared<EvalFlags>();
  command.Flags("Playing")
      .Add("policy", "FILE", &flags->policy, "Policy file")
      .Add("against", "FILE", &flags->against,
           "Policy file to compare with on the same starts; default: none")
      .Add("env", "ID", &flags->env, "Environment; default: the policy's")
      .Add("episodes", "N", &flags->options.episodes, "Episodes to play")
      .Add("seed", "N", &flags->options.first_seed,
           "Seed of the first episode; each later one adds 1")
      .AddList("target_returns", "RETURN,...", &flags->target_returns,
               "Target returns; default: that of the policy")
      .AddList("ablate", "PART,...", &flags->ablate,
               "Parts to omit: context, changes, attention, phase, routing, return")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.SetAction([flags] { return EvaluatePolicy(*flags); });
}

}  // namespace spikeserve
